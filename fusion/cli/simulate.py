"""`fusion simulate`: sample data with known truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

Preset = Literal["clear", "dark", "dusty", "over-exposed"]
Rings = Literal[16, 32, 64, 128]


def simulate_mine(
    out: Annotated[Path, Parameter(help="Folder to write; it must be new or empty.")],
    /,
    *,
    config: Annotated[
        Path | None, Parameter(help="TOML with any parameter of scene, flight and sensors; options win.")
    ] = None,
    preset: Annotated[Preset | None, Parameter(help="What it looks like. Default: clear.")] = None,
    seed: Annotated[
        int | None, Parameter(help="Another mine and flight. The same seed, the same bytes.")
    ] = None,
    duration: Annotated[float | None, Parameter(help="Seconds. Default: 10.")] = None,
    speed: Annotated[float | None, Parameter(help="Of the drone, metres a second. Default: 1.5.")] = None,
    max_rate: Annotated[
        float | None, Parameter(help="Of its turning, degrees a second. Default: 90.")
    ] = None,
    rings: Annotated[Rings | None, Parameter(help="Of the LiDAR. Default: 64.")] = None,
    truth: Annotated[
        bool | None,
        Parameter(negative="--no-truth", help="Write dense truth too (depth, flow, temperature). Default."),
    ] = None,
    workers: Annotated[
        int | None, Parameter(help="Threads. Default: one a core; the output is the same.")
    ] = None,
    quiet: Annotated[bool, Parameter(help="No progress, no table.")] = False,
) -> None:
    """Fly through a synthetic mine: RGB, thermal, LiDAR, and the truth beside them."""
    from fusion.cli.running import progress_bar, threads_of
    from fusion.simulate.mine.recording import make_mine

    flight = _given(speed_m_s=speed, max_rate_deg_s=max_rate)
    settings = _settings(
        config,
        preset=preset,
        seed=seed,
        duration_s=duration,
        truth=truth,
        flight=flight,
        lidar=_given(rings=rings),
    )
    with _once(out), progress_bar("filming", quiet) as progress:
        report = make_mine(out, settings, progress=progress, threads=threads_of(workers))
    if not quiet:
        print(
            f"{report.rgb} RGB and {report.fir} thermal frames ({report.frozen} frozen), {report.lidar} scans"
        )
        print(f"in {out}: rgb/, fir/, lidar/ and truth/; stamps are each sensor's own, see truth/clocks.toml")


def simulate_session(
    out: Annotated[Path, Parameter(help="Folder to write; it must be new or empty.")],
    /,
    *,
    config: Annotated[Path | None, Parameter(help="TOML as for simulate mine.")] = None,
    board: Annotated[
        Literal["chessboard", "circles"] | None,
        Parameter(help="What is printed on it. Default: a chessboard, or what --config says."),
    ] = None,
    poses: Annotated[int | None, Parameter(help="How often the board is shown. Default: 30.")] = None,
    seed: Annotated[int | None, Parameter(help="Other poses. The same seed, the same bytes.")] = None,
    quiet: Annotated[bool, Parameter(help="No progress, no table.")] = False,
) -> None:
    """Show a heated board to all three sensors, for calibration."""
    from fusion.cli.running import progress_bar
    from fusion.simulate.mine.scene_config import BoardConfig
    from fusion.simulate.mine.session import make_session

    printed = BoardConfig.circles() if board == "circles" else BoardConfig()
    shown = (
        {}
        if board is None
        else {name: getattr(printed, name) for name in ("kind", "cols", "rows", "square_m")}
    )
    settings = _settings(config, seed=seed, board={**shown, **_given(poses=poses)})
    with _once(out), progress_bar("filming", quiet) as progress:
        report = make_session(out, settings, progress=progress)
    if not quiet:
        print(f"{report.rgb} poses of a {settings.board.kind} in {out}: rgb/, fir/, lidar/ and truth/")


@contextmanager
def _once(out: Path) -> Iterator[None]:
    """Says, when interrupted, that a simulation starts afresh."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{out} is incomplete: delete it, a simulation starts afresh") from None


def _settings(config: Path | None, **options: Any) -> Any:
    from fusion.simulate.mine.config import load_mine_config

    return load_mine_config(config, _given(**options))


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None and value != {}}


def simulate_pairs(
    out: Path,
    *,
    frames: int = 12,
    seed: int = 0,
    rgb_size: tuple[int, int] = (640, 480),
    fir_size: tuple[int, int] = (640, 512),
) -> None:
    """Make a short synthetic sequence of unregistered RGB and 16-bit thermal pairs in a mine drift.

    Beside the images lie points.csv, correspondences as a hand would pick them (two of them wrong), and
    truth.toml with the exact homography.

    Examples:

    `fusion simulate pairs sample`

    `fusion blend sample/rgb sample/fir --pair index --points sample/points.csv -o fused`

    Parameters
    ----------
    out
        Folder to write; rgb/, fir/, points.csv and truth.toml must not be in it yet.
    frames
        Number of pairs, ten a second.
    seed
        The same seed gives the same bytes.
    rgb_size
        Width and height of the RGB camera, even, 96 to 2048 pixels.
    fir_size
        Width and height of the thermal camera, even, 96 to 2048 pixels.
    """
    from fusion.simulate.pairs import make_pairs

    make_pairs(out, frames=frames, rgb_size_wh=rgb_size, fir_size_wh=fir_size, seed=seed)
    print(f"{frames} pairs in {out}: rgb/, fir/, points.csv, truth.toml")
