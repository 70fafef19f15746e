"""The errors that reach a user: what is wrong, where, and what to do next.

Everything the package raises on purpose is a `FusionError`; its text is one line. Only the command
line prints and exits; library callers catch `FusionError` or one of its kinds.
"""

from __future__ import annotations

MOST_LETTERS = 2000  # of an error's line


class FusionError(Exception):
    """What went wrong, where, and what to do next, in one line.

    Parameters: `what` states the fact, `where` names the file, frame or option, `hint` says what to
    do about it. `exit_code` is what the command line ends with.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object = "", hint: str = "") -> None:
        self.what = what
        self.where = str(where)
        self.hint = hint
        super().__init__(what)

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        text = f"{text} ({self.hint})" if self.hint else text
        line = " ".join(text.split())
        if len(line) > MOST_LETTERS:  # it quotes a file that holds a long word
            line = f"{line[: MOST_LETTERS - 300]} … {line[-290:]}"
        return line


class UsageError(FusionError):
    """An option, configuration or registration cannot be right."""

    exit_code = 2


class InputError(FusionError):
    """The input as a whole cannot be used: nothing there, nothing matches, not registered."""


class FrameError(FusionError):
    """One frame cannot be used. It is skipped, counted and named, or stops a strict run."""


class OutputError(FusionError):
    """The output cannot be written, or holds something that must not be overwritten."""
