"""docs/scale.md: its manifests parse, its commands have the options they use, its arithmetic adds up."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")


def blocks(language: str) -> str:
    return "\n".join(re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL))


def options_of(*command: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-m", *command, "--help"], capture_output=True, text=True, check=True
    )
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", done.stdout))


@pytest.mark.parametrize("command", [("dask", "scheduler"), ("dask", "worker"), ("fusion", "preprocess")])
def test_options_exist(command: tuple[str, str]) -> None:
    pytest.importorskip("distributed")
    text = (blocks("sh") + blocks("yaml")).replace("\\\n", " ").replace("[", " ").replace(", ", " ")
    lines = [line.partition(" ".join(command))[2] for line in text.splitlines() if " ".join(command) in line]
    used = {
        option for line in lines for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", line.split("#")[0])
    }
    assert len(lines) >= 3
    assert used
    assert used <= options_of(*command)


def test_manifests_fit_together() -> None:
    found = {
        (one["kind"], one["metadata"]["name"]): one["spec"] for one in yaml.safe_load_all(blocks("yaml"))
    }
    assert sorted(kind for kind, _ in found) == ["Deployment", "Deployment", "Job", "Service"]
    service = found["Service", "fusion-scheduler"]
    for (kind, name), spec in found.items():
        if kind == "Deployment":
            assert spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"] == {"app": name}
        for container in spec.get("template", {}).get("spec", {}).get("containers", []):
            assert all(isinstance(word, str) for word in container["command"])
            for word in container["command"]:
                if word.startswith("tcp://"):
                    assert word == f"tcp://fusion-scheduler:{service['ports'][0]['port']}"


def test_the_arithmetic(tmp_path: Path) -> None:
    """Two chunks of two frames, 4 s of work, 4000 bytes in, 800 out in four files."""
    out, recording = tmp_path / "out", tmp_path / "one.bag"
    recording.write_bytes(bytes(4000))
    (out / "chunks").mkdir(parents=True)
    for index in range(2):
        record = {"seconds": 2.0, "files": {"a": 300, "b": 100}}
        (out / f"chunks/{index:06d}.json").write_text(json.dumps(record))
    (out / "frames.csv").write_text(
        "stem,status\n" + "".join(f"{n},made\n" for n in range(4)) + "5,skipped\n"
    )
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- begin: made by scale_table.py -->\nold\n<!-- end: made by scale_table.py -->\nafter\n"
    )
    command = [
        sys.executable,
        str(ROOT / "benchmarks/scale_table.py"),
        str(recording),
        str(out),
        "--write",
        str(page),
    ]
    subprocess.run(command, check=True, capture_output=True)
    text = page.read_text()
    rows = dict(re.findall(r"^\| ([^|]*) \|(?:[^|]*\|)? ([^|]*) \|$", text, re.MULTILINE))
    assert rows["*s*, seconds of a worker a frame"] == "1"
    assert rows["*a*, bytes read a frame"] == "1 kB"
    assert rows["frames in 10 TB"] == "10,000,000,000"
    assert rows["written"] == "2 TB"
    assert rows["chunks, and records"] == "5,000,000,000"
    assert rows["a worker's hours"] == "2,777,778"
    assert rows["bytes a worker moves a second"] == "1.2 kB"
    assert rows["lost at most when a worker dies"] == "2 s"
    assert rows["hours with 16 workers"] == "173,611.1"
    assert "old" not in text
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
