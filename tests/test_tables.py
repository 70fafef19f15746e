"""Look-up by name, with a real installed distribution beside our own rows."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fusion.blend import BLENDERS, blender
from fusion.errors import UsageError
from fusion.tables import lookup

Install = Callable[[str, str, str], None]
GROUP = "fusion.blenders"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a module as its own distribution, with these lines under the entry points of the blenders."""
    known = set(sys.modules)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def _install(module: str, source: str, lines: str) -> None:
        site = tmp_path / module
        info = site / f"{module}-1.0.dist-info"
        info.mkdir(parents=True)
        (site / f"{module}.py").write_text(source)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{lines}\n")
        monkeypatch.syspath_prepend(str(site))

    yield _install
    for name in set(sys.modules) - known:
        if name.startswith("extra_"):
            del sys.modules[name]


def test_an_installed_blender_is_found_and_only_then_imported(install: Install) -> None:
    install("extra_one", "def rgb_only(bgr, *_):\n    return bgr.copy()", "rgb-only = extra_one:rgb_only")
    assert blender("alpha") is BLENDERS["alpha"]
    assert "extra_one" not in sys.modules
    assert blender("rgb-only").__name__ == "rgb_only"  # type: ignore[attr-defined]
    assert "extra_one" in sys.modules


def test_our_own_row_is_never_replaced(install: Install) -> None:
    install("extra_two", "def mine(): ...", "alpha = extra_two:mine")
    assert blender("alpha") is BLENDERS["alpha"]


def test_an_unknown_name_lists_ours_and_theirs(install: Install) -> None:
    install("extra_three", "", "theirs = extra_three:x\nalpha = extra_three:y")
    with pytest.raises(UsageError) as caught:
        blender("absent")
    assert "unknown blender 'absent'" in str(caught.value)
    assert caught.value.hint == "one of: alpha, laplacian, theirs"


def test_a_name_offered_twice_is_refused_with_both_places(install: Install) -> None:
    install("extra_four", "def f(): ...", "twice = extra_four:f")
    install("extra_five", "def f(): ...", "twice = extra_five:f")
    with pytest.raises(UsageError, match="offered twice: extra_five:f, extra_four:f"):
        blender("twice")


@pytest.mark.parametrize(
    ("source", "complaint"),
    [("", "AttributeError"), ("import extra_absent", "ModuleNotFoundError"), ("1 / 0", "ZeroDivisionError")],
)
def test_a_package_that_does_not_load_is_one_clear_line(
    install: Install, source: str, complaint: str
) -> None:
    install("extra_six", source, "broken = extra_six:f")
    with pytest.raises(UsageError, match=f"blender 'broken' cannot be loaded from extra_six:f: {complaint}"):
        blender("broken")


def test_values_need_not_be_functions() -> None:
    assert lookup({"a": 1, "b": 2}, "fusion.nothing", "b", "number") == 2
    with pytest.raises(UsageError, match=r"unknown number 'c' \(one of: a, b\)"):
        lookup({"a": 1, "b": 2}, "fusion.nothing", "c", "number")
