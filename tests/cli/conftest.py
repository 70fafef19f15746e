from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from fusion.cli.main import main


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


@pytest.fixture
def fusion(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Run the command line in this process: fusion("blend", rgb, fir, "-o", out)."""

    def call(*words: object) -> Answer:
        monkeypatch.setattr(sys, "argv", ["fusion", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        code = ended.value.code
        return Answer(code if isinstance(code, int) else 0 if code is None else 1, said.out, said.err)

    return call
