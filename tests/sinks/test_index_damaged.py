"""An index that is no CSV: found by `make fuzz`."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.errors import MOST_LETTERS, InputError
from fusion.preprocess.config import load_preprocess_config
from fusion.sinks.index import Row, read_rows


def test_a_cell_longer_than_any_cell(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("stem\n" + "x" * 200_000 + "\n")
    with pytest.raises(InputError, match=r"is no index.*delete it"):
        read_rows(path, Row)


def test_an_error_that_quotes_a_long_word_is_still_a_line() -> None:
    error = InputError("x" * 50_000, where="a.toml", hint="what to do")
    assert len(str(error)) <= MOST_LETTERS
    assert str(error).startswith("a.toml: xxx")
    assert str(error).endswith("x (what to do)")


@pytest.mark.parametrize("text", ["a = " + "[" * 30_000, "a = " + "9" * 5000])
def test_settings_made_to_break_their_reader(text: str, tmp_path: Path) -> None:
    from fusion.errors import UsageError

    path = tmp_path / "a.toml"
    path.write_text(f'format = "fusion-preprocess/1"\n{text}\n')
    with pytest.raises(UsageError, match="cannot be read as TOML"):
        load_preprocess_config(path, {})
