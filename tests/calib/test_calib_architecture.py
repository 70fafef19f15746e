"""calib stands on the lower floors of fusion, speaks to nobody, and is imported by the command line only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
MAY_IMPORT = {
    "codecs",
    "errors",
    "files",
    "frames",
    "geometry",
    "homography",
    "kernels",
    "registration",
    "rig",
    "settings",
    "tables",
}


def imports(path: Path) -> Iterator[tuple[str, str]]:
    """(package, part) of every import of ours in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            package, _, rest = node.module.partition(".")
            for part in [rest.split(".")[0]] if rest else [alias.name for alias in node.names]:
                yield package, part
        if isinstance(node, ast.Import):
            for alias in node.names:
                package, _, rest = alias.name.partition(".")
                yield package, rest.split(".")[0]


def test_calib_imports_the_lower_floors_only() -> None:
    found = {
        (path.relative_to(ROOT).as_posix(), part)
        for path in (ROOT / "calib").rglob("*.py")
        for package, part in imports(path)
        if package == "fusion" and part not in MAY_IMPORT
    }
    assert found == set()


def test_of_fusion_only_the_command_line_imports_calib() -> None:
    found = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "fusion").rglob("*.py")
        if path.parts[-2] != "cli" and any(package == "calib" for package, _ in imports(path))
    }
    assert found == set()


def test_calib_neither_prints_nor_exits() -> None:
    for path in (ROOT / "calib").rglob("*.py"):
        calls = {
            ast.unparse(node.func)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call)
        }
        assert not calls & {"print", "sys.exit", "exit"}, path


def test_the_architecture_page_knows_every_part() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    parts = [path.stem for path in (ROOT / "calib").glob("*.py") if path.stem != "__init__"]
    folders = [
        path.name for path in (ROOT / "calib").iterdir() if path.is_dir() and path.name != "__pycache__"
    ]
    missing = [p for p in parts if f"{p}.py" not in page] + [f for f in folders if f"calib/{f}/" not in page]
    assert missing == []
