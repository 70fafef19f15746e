"""`fusion simulate`: sample data with known truth."""

from __future__ import annotations

from pathlib import Path


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
