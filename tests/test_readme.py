"""What the documents say is so: their code runs, their commands parse, their links lead somewhere."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from cyclopts import CoercionError, MissingArgumentError

from fusion.blend import blender
from fusion.cli.blending import PLACES
from fusion.cli.depthing import PLACES as DEPTH_PLACES
from fusion.cli.main import app
from fusion.colormaps import colormap_bgr
from fusion.config import BlendConfig, load_config
from fusion.lidar.config import DepthConfig, load_depth_config
from tests.worlds import read, write_pairs

ROOT = Path(__file__).parents[1]
README, CONFIGURATION = ROOT / "README.md", ROOT / "docs" / "configuration.md"
DOCUMENTS = [
    README,
    ROOT / "CONTRIBUTING.md",
    ROOT / "datasets" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
SPOKEN_OF = {
    "depth.md": "fusion depth cloud.pcd",
    "mine.md": "fusion simulate mine mine/",
    "calibration.md": "fusion calibrate lidar rgb/ lidar/ --rig rig.toml -o out.toml",
    "preprocess.md": "fusion preprocess flight.mcap -o out/",
    "scale.md": "fusion preprocess flight.mcap -o out/",
    "timing.md": "fusion preprocess flight.mcap -o out/",
    "inspect.md": "fusion inspect flight.mcap",
    "add-a-dataset.md": "fusion preprocess mine mine/ -o out/",
}
OTHERS = (
    "fusion preprocess flight.mcap -o out/",
    "fusion inspect flight.mcap",
    "fusion datasets check mine mine/",
    "fusion simulate record mine/ mine.bag --form rosbag1",
)
FOREIGN = {  # options of Dask's commands, and of the benchmarks' scripts
    *("--tls-ca-file", "--tls-cert", "--tls-key", "--nworkers", "--no-dashboard", "--death-timeout"),
    *("--lifetime", "--keep"),
}
SHELLS = ("", "sh", "bash", "console")


class Block(NamedTuple):
    """A fenced block of a document: its language, its text, and the document's name."""

    language: str
    text: str
    document: str


def blocks(document: Path) -> list[Block]:
    found = re.findall(
        r"^```(\w*)\n(.*?)^```$", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    return [Block(language, text, document.name) for language, text in found]


def name_of(value: object) -> str:
    """What pytest calls a document, or a line of one, in its report."""
    return value.relative_to(ROOT).as_posix() if isinstance(value, Path) else str(value).split(" ")[0]


def prose(document: Path) -> str:
    """The text without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


# --- code


@pytest.fixture
def beside_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with rgb/ and fir/ of six pairs, and we are in it."""
    write_pairs(tmp_path, 6, bits=16)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_readme_shows_the_library_in_five_lines() -> None:
    (code,) = (block.text for block in blocks(README) if block.language == "python")
    lines = [line for line in code.splitlines() if line.strip() and "import" not in line]
    assert "from fusion import" in code
    assert len(lines) <= 5


def test_the_readmes_code_prints_a_line_for_every_pair(
    beside_pairs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each line has the stem, the shape and the window: the percentiles of all thermal pixels, by numpy."""
    for block in blocks(README):
        if block.language == "python":
            exec(compile(block.text, block.document, "exec"), {})
    fir = sorted((beside_pairs / "fir").iterdir())
    lo, hi = np.percentile(np.stack([read(path) for path in fir]), [1, 99])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(fir) == 6
    for line, path in zip(lines, fir, strict=True):
        assert line.startswith(f"{path.stem} (48, 64, 3) ")
        window = re.search(r"lo=([\d.]+), hi=([\d.]+)", line)
        assert window is not None, line
        assert [float(limit) for limit in window.groups()] == pytest.approx([lo, hi], abs=1e-9)


@pytest.mark.parametrize("document", DOCUMENTS[1:], ids=name_of)
def test_code_in_other_documents_runs(beside_pairs: Path, document: Path) -> None:
    for block in blocks(document):
        if block.language == "python":
            exec(compile(block.text, block.document, "exec"), {})


# --- commands


def test_the_two_commands_come_first() -> None:
    commands = [line.split("#")[0].split() for line in blocks(README)[0].text.splitlines()]
    assert commands == [["make", "demo"], ["make", "test"]]
    first_code = README.read_text(encoding="utf-8").index("`")
    assert README.read_text(encoding="utf-8")[first_code:].startswith("```\nmake demo")
    rules = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^demo:", rules, re.MULTILINE)
    assert re.search(r"^test:", rules, re.MULTILINE)


def command_lines(document: Path) -> Iterator[str]:
    """Whole commands: lines of shell blocks, fenced or indented, and of the Makefile's recipes."""
    shell = "".join(block.text for block in blocks(document) if block.language in SHELLS)
    indented = "\n".join(re.findall(r"^    .*$", prose(document), re.MULTILINE))
    text = f"{shell}\n{indented}".replace("\\\n", " ")
    yield from (line.strip() for line in text.splitlines() if line.strip().startswith("fusion "))


def spoken(document: Path) -> Iterator[str]:
    """Commands and options within the text and its tables: spans of code."""
    for span in re.findall(r"`([^`\n]+)`", prose(document)):
        if span.startswith("fusion "):
            yield span
        elif span.startswith("--") and span.split()[0] not in FOREIGN:
            yield f"{_command_with(span.split()[0], document.name)} {span}"


def _command_with(option: str, document: str) -> str:
    """The document's own command, or another one that has the option."""
    own = SPOKEN_OF.get(document, "fusion blend rgb/ fir/")
    for command in (own, *OTHERS):
        words = command.split()[1:]
        path = words[:2] if words[0] in ("simulate", "calibrate", "datasets") else words[:1]
        if option in options_of(*path):
            return command
    return own


def parse(line: str) -> None:
    app.parse_args(shlex.split(line, comments=True)[1:], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_every_command_shown_is_one(document: Path) -> None:
    for line in command_lines(document):
        parse(line)


def options_of(*command: str) -> set[str]:
    arguments = app[command[0]] if len(command) == 1 else app[command[0]][command[1]]
    collected = arguments.assemble_argument_collection(default_parameter=app.default_parameter)
    return {name for argument in collected for name in argument.names}


OPTIONS = options_of("blend")
ALL_OPTIONS = OPTIONS.union(
    options_of("depth"),
    options_of("simulate", "mine"),
    options_of("calibrate", "stereo"),
    options_of("calibrate", "lidar"),
    options_of("calibrate", "convert"),
    options_of("preprocess"),
    options_of("inspect"),
    options_of("datasets", "check"),
    options_of("simulate", "record"),
)


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_every_command_spoken_of_could_be_one(document: Path) -> None:
    """In passing, arguments may be missing or stand for something (LO HI), but no word is unknown."""
    for line in spoken(document):
        words = [word for word in shlex.split(line) if word != "…"]
        try:
            parse(shlex.join(words))
        except (MissingArgumentError, CoercionError) as error:
            if isinstance(error, CoercionError) and not any(word.isupper() for word in words):
                raise
            assert {word for word in words if word.startswith("-")} <= ALL_OPTIONS, line


def test_the_readme_shows_enough_to_be_worth_parsing() -> None:
    assert len(list(command_lines(README))) >= 1
    assert len(list(spoken(README))) >= 12


def test_the_makefile_runs_commands_that_parse() -> None:
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = re.findall(r"bin/fusion ([^&\n]+)|\$\(BIN\)/fusion ([^&\n]+)", text)
    assert len(lines) >= 4
    for line in lines:
        parse(f"fusion {''.join(line)}")


# --- links


def anchors(document: Path) -> set[str]:
    titles = re.findall(r"^#+ (.*)$", prose(document), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = document.parent / path if path else document
        assert there.exists(), f"{document.name}: {target}"
        assert not anchor or anchor in anchors(there), f"{document.name}: {target}"


def test_every_document_is_linked_from_the_readme() -> None:
    linked = {
        (ROOT / target.partition("#")[0]).resolve() for target in re.findall(r"\]\(([^):]+)\)", prose(README))
    }
    assert {path.resolve() for path in DOCUMENTS} - {README.resolve()} <= linked
    assert {path.resolve() for path in (ROOT / "notebooks").glob("*.ipynb")} <= linked


# --- configuration


def toml_block() -> str:
    (text,) = (block.text for block in blocks(CONFIGURATION) if block.language == "toml")
    return text


def test_the_documented_configuration_is_one(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(toml_block(), encoding="utf-8")
    config = load_config(path, {})
    config.pairing.rule()
    colormap_bgr(config.thermal.colormap)
    blender(config.blend.method)
    assert config.warp.homography == str(tmp_path / "H.toml")


def depth_block() -> str:
    (text,) = (block.text for block in blocks(ROOT / "docs" / "depth.md") if block.language == "toml")
    return text


def test_the_documented_depth_configuration_is_one_and_whole(tmp_path: Path) -> None:
    """Every setting stands in its table, in use or in a comment; what can be is the default."""
    path = tmp_path / "depth.toml"
    path.write_text(depth_block(), encoding="utf-8")
    config, defaults = load_depth_config(path, {}), DepthConfig.of()
    for table in ("cloud", "camera", "samples", "dense", "picture"):
        shown, group = tomllib.loads(depth_block())[table], getattr(config, table)
        part = depth_block().split(f"[{table}]")[1].split("\n[")[0]
        commented = re.findall(r"^# (\w+) = ", part, re.MULTILINE)
        assert {*shown, *commented} == set(type(group).model_fields), table
        for key in set(shown) - {"form", "range_m", "box_m", "voxel_m", "outliers", "max_gap_px"}:
            known = getattr(getattr(defaults, table), key)
            if known is not None:
                assert getattr(group, key) == pytest.approx(known, abs=0.01), key


def test_every_depth_option_has_its_place_and_every_documented_preset_is_true() -> None:
    config = DepthConfig.of(preset="thesis")
    row = ["`thesis`", config.samples.value, config.samples.visibility, f"`{config.dense.method}`"]
    assert f"| {' | '.join([*row, config.dense.extrapolate])} |" in prose(ROOT / "docs" / "depth.md")
    for option, place in DEPTH_PLACES.items():
        assert f"--{option.replace('_', '-')}" in options_of("depth"), option
        group = DepthConfig.model_fields if len(place) == 1 else type(getattr(config, place[0])).model_fields
        assert place[-1] in group, option


def commented_settings() -> list[tuple[str, str]]:
    """(table, line) of the settings that the documented file holds in comments."""
    found, table = [], ""
    for line in toml_block().splitlines():
        table = line.strip("[]") if line.startswith("[") else table
        if re.match(r"# \w+ = ", line):
            found.append((table, line.removeprefix("# ")))
    return found


@pytest.mark.parametrize(("table", "line"), commented_settings(), ids=name_of)
def test_documented_alternatives_are_right_in_a_file_of_their_own(
    tmp_path: Path, table: str, line: str
) -> None:
    path = tmp_path / "run.toml"
    key = line.split(" = ")[0]
    rig = 'rig = "rig.toml"\n' if key in ("mode", "distance_m", "depth") else ""  # they go with it
    path.write_text(f'format = "fusion-blend/1"\n[{table}]\n{rig}{line}\n', encoding="utf-8")
    config = load_config(path, {})
    config.pairing.rule()
    assert key in getattr(config, table).model_fields_set


def test_every_setting_is_documented_in_its_table() -> None:
    shown = tomllib.loads(toml_block())
    for table, line in commented_settings():
        shown[table].setdefault(line.split(" = ")[0], None)
    effective = BlendConfig.of()
    assert set(shown) == set(BlendConfig.model_fields)
    for table in BlendConfig.model_fields:
        group = getattr(effective, table)
        if hasattr(group, "model_fields_set"):
            assert set(shown[table]) == set(type(group).model_fields), table


def test_every_option_is_documented_with_its_key() -> None:
    """The table of options: `--pair` | `pairing.by`; options without a key stand there too."""
    rows = re.findall(r"^\| `(--[a-z-]+)[^`]*` \| (?:`([a-z_.]+)`)?", prose(CONFIGURATION), re.MULTILINE)
    keys = dict(rows)
    assert len(keys) == len(rows)
    assert set(keys) == {option for option in OPTIONS if option.startswith("--")}
    places = {f"--{option.replace('_', '-')}": ".".join(place) for option, place in PLACES.items()}
    assert {option: key for option, key in keys.items() if key} == places


def test_documented_defaults_are_the_defaults() -> None:
    """The table of presets, cell by cell, against the presets."""
    rows = re.findall(r"^\| ([a-z ]+) \| (.+?) \| (.+?) \|$", prose(CONFIGURATION), re.MULTILINE)
    said = {label: cells for label, *cells in rows}
    for column, preset in enumerate(("auto", "thesis")):
        config = BlendConfig.of(preset=preset)
        assert said["colour map"][column] == f"`{config.thermal.colormap}`"
        assert said["outside"][column] == f"`{config.warp.outside}`"
        assert float(said["alpha"][column]) == config.blend.alpha
        numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", said["window"][column])]
        assert numbers[:2] == list(config.thermal.window)
