"""Where the benchmarks keep their files, how they call `fusion`, and what the machine is."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil
from content import Case, write_folder
from timing import clocked

MEMORY_BACKED = Path("/dev/shm")
LIBRARIES = ("numpy", "opencv-contrib-python-headless", "numba", "fpng", "simplejpeg")
FUSION = Path(sys.executable).with_name("fusion")  # not resolved: the environment's own


class Workspace:
    """A temporary folder, in memory where the system has such storage, with pairs made once per kind."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.out = root / "out"
        self._pairs: dict[tuple[Case, int, str], Path] = {}

    def pairs(self, case: Case, distinct: int, count: int, suffix: str = ".png") -> Path:
        key = (case, count, suffix)
        if key not in self._pairs:
            self._pairs[key] = self.root / f"pairs{len(self._pairs)}"
            write_folder(self._pairs[key], case, distinct, count, suffix)
        return self._pairs[key]

    def fresh_out(self) -> Path:
        shutil.rmtree(self.out, ignore_errors=True)
        return self.out


@contextmanager
def workspace() -> Iterator[Workspace]:
    parent = MEMORY_BACKED if os.access(MEMORY_BACKED, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="fusion-bench-", dir=parent) as folder:
        yield Workspace(Path(folder))


def storage() -> str:
    if os.access(MEMORY_BACKED, os.W_OK):
        return "files in memory-backed storage (tmpfs)"
    return "files in the system's temporary folder (**not in memory: the disk is part of the figures**)"


def blend_command(
    case: Case, pairs: Path, out: Path, *, workers: int, suffix: str = ".png", one_pair: bool = False
) -> list[str]:
    """`fusion blend` with the window fixed, of all pairs or of the first alone."""
    inputs = [pairs / role / f"000000{suffix}" if one_pair else pairs / role for role in ("rgb", "fir")]
    return [
        *(str(FUSION), "blend", *map(str, inputs), "-o", str(out), "--quiet"),
        *("--window", str(case.window[0]), str(case.window[1]), "--window-unit", "counts"),
        *("--workers", str(workers), "--format", suffix.removeprefix(".")),
    ]


def run_clocked(command: list[str]) -> float:
    """Seconds of a whole process, from its start to its end. Raises with its last words if it fails."""

    def run() -> None:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command[:2])} failed: {done.stderr.strip()[-500:]}")

    return clocked(run)


def machine_lines() -> list[str]:
    """Processor, cores, memory, system, load when asked."""
    memory = psutil.virtual_memory().total / 2**30
    load = os.getloadavg()[0]
    return [
        f"- processor: {_cpu_model()}, {len(os.sched_getaffinity(0))} cores to use",
        f"- memory: {memory:.0f} GiB; system: {platform.system()} {platform.release()}, {platform.machine()}",
        f"- load average when the run began: {load:.2f}"
        + (" (**not quiet: figures are soft**)" if load > 0.5 else ""),
    ]


def version_lines() -> list[str]:
    libraries = ", ".join(f"{name} {_version(name)}" for name in LIBRARIES)
    return [
        f"- Python {platform.python_version()}; fusionprep {_version('fusionprep')}; {libraries}",
        f"- {_first_line(['ffmpeg', '-version'])}",
        f"- {_first_line([_magick_name(), '-version'])}",
    ]


def _magick_name() -> str:
    return "convert-im6.q16" if shutil.which("convert-im6.q16") else "convert"


def _cpu_model() -> str:
    with Path("/proc/cpuinfo").open() as lines:
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _first_line(command: list[str]) -> str:
    if not shutil.which(command[0]):
        return f"{command[0]}: not installed"
    done = subprocess.run([*command], capture_output=True, text=True, check=False)
    words = (done.stdout.splitlines() or ["?"])[0].removeprefix("Version: ")
    return words.split(" Copyright")[0].split(" https://")[0]
