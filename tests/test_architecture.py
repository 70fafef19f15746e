"""The house keeps its order: imports go one way, the public names exist, manifests are no Python."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import fusion

ROOT = Path(__file__).parents[1]
FLOORS = [
    {"errors", "frames"},
    {
        "files",
        "tables",
        "settings",
        "open3d",
        "codecs",
        "png",
        "png16",
        "unfilter",
        "kernels",
        "kernels16",
        "geometry",
        "recordings",
        "timing",
    },
    {"rig", "radiometric", "storage"},
    {
        "chunks",
        "sources",
        "pairing",
        "homography",
        "registration",
        "warp",
        "rig_warp",
        "rig_warp_kernels",
        "colormaps",
        "thermal",
        "blend",
        "manifest",
        "clouds",
    },
    {"lidar", "messages"},
    {"foxglove"},
    {"sync", "config", "simulate"},
    {"fusing"},
    {"pipeline"},
    {"sinks", "provenance"},
    {"batch"},
    {"preprocess"},
    {"report"},
    {"inspect"},
    {"cli"},
]
FLOOR_OF = {name: floor for floor, names in enumerate(FLOORS) for name in names}
SAME_FLOOR = {
    ("codecs", "png"),
    ("png", "unfilter"),
    ("codecs", "png16"),
    ("png16", "kernels"),
    ("unfilter", "kernels"),
    ("registration", "homography"),
    ("registration", "warp"),
    ("rig_warp", "warp"),
    ("rig_warp", "rig_warp_kernels"),
    ("manifest", "pairing"),
    ("pairing", "sources"),
    ("clouds", "sources"),
    ("clouds", "pairing"),
    ("kernels16", "kernels"),
    ("manifest", "sources"),
    ("manifest", "clouds"),
}


def modules() -> Iterator[tuple[str, Path]]:
    for path in sorted((ROOT / "fusion").rglob("*.py")):
        parts = path.relative_to(ROOT / "fusion").with_suffix("").parts
        if parts[0] not in ("__init__", "__main__"):
            yield parts[0], path


def imported(path: Path) -> set[str]:
    """The parts of the package that a file imports (not those that only its type checker sees)."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    hidden = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ImportFrom)
            and id(node) not in hidden
            and (node.module or "").split(".")[0] == "fusion"
        ):
            names = (node.module or "").split(".")[1:2] or [alias.name for alias in node.names]
            found.update(names)
        if isinstance(node, ast.Import):
            found.update(alias.name.split(".")[1] for alias in node.names if alias.name.startswith("fusion."))
    return found


def test_every_part_has_its_floor() -> None:
    assert {part for part, _ in modules()} == set(FLOOR_OF)


def test_imports_go_down() -> None:
    upward = [
        f"{path.relative_to(ROOT)} imports fusion.{other}"
        for part, path in modules()
        for other in imported(path) - {part}
        if FLOOR_OF[other] >= FLOOR_OF[part] and (part, other) not in SAME_FLOOR
    ]
    assert upward == []


def test_only_the_command_line_prints_and_exits() -> None:
    for part, path in modules():
        calls = {
            ast.unparse(n.func) for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)
        }
        assert part == "cli" or not calls & {"print", "sys.exit", "exit"}, path


def test_public_names_are_what_the_package_says() -> None:
    assert sorted(fusion.__all__) == fusion.__all__
    for name in fusion.__all__:
        assert getattr(fusion, name).__name__ == name


def test_architecture_page_knows_every_part() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    missing = [part for part in FLOOR_OF if f"{part}.py" not in page and f"fusion/{part}/" not in page]
    assert missing == []


def test_manifests_are_no_python_and_the_distribution_has_its_own_name() -> None:
    assert not list((ROOT / "datasets").rglob("*.py"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["name"] == "fusionprep"
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["fusion", "calib"]
