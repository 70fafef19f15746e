"""Open3D is loaded late, and where it cannot be, one line says what is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fusion.errors import FusionError
from fusion.open3d import load


def test_it_is_there_and_the_same_each_time() -> None:
    assert load() is load()
    assert load().core.Tensor([1.0]).shape == (1,)


def test_where_it_cannot_load_one_line_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    load.cache_clear()
    monkeypatch.setitem(sys.modules, "open3d", None)  # what an import of a broken library raises
    with pytest.raises(FusionError, match="libegl1") as caught:
        load()
    assert "\n" not in str(caught.value)
    load.cache_clear()


@pytest.mark.parametrize("command", ["--help", "depth --help", "simulate mine --help"])
def test_help_loads_nothing_heavy(command: str) -> None:
    code = (
        "import sys; sys.argv = ['fusion', *sys.argv[1:]]\n"
        "from fusion.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'open3d', 'scipy', 'numba', 'cv2', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *command.split()], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"
