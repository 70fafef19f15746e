"""What the texts of all runs share."""

from __future__ import annotations

LOUD_SKIPS = 10  # named on the terminal; the index names all


def table(rows: list[tuple[str, str]]) -> list[str]:
    """Two columns of text, the first as wide as its longest word."""
    width = max(len(label) for label, _ in rows)
    return [f"{label:<{width}}  {text}" for label, text in rows]
