"""The joint solve of cameras, LiDAR, clocks and boards: one robust least-squares problem."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.boards import Board
from calib.observations import CloudView, View
from calib.solve.blocks import Block, blocks_of, by_part
from calib.solve.checking import Dropped, check_fixed, check_input, check_linked, label, usable, usable_clouds
from calib.solve.descent import Descent, Fit, Progress
from calib.solve.determined import check_angles, check_determined, poorly_told_apart
from calib.solve.estimate import Estimate, Solution
from calib.solve.normal import inverse
from calib.solve.robust import poor_parts, starved
from calib.solve.state import Layout
from fusion.errors import InputError, UsageError
from fusion.geometry import Floats

_LEAST_NOISE_PX = 0.01
_ABSURD_SHARE = 0.02  # noise beyond this share of an image's width: another board, or another camera


def solve(
    board: Board,
    views: Sequence[View],
    clouds: Sequence[CloudView] = (),
    *,
    start: Estimate,
    fixed: Collection[str] = (),
    robust: bool = True,
    drop_views: bool = True,
    progress: Progress | None = None,
) -> Solution:
    """The cameras, sensors' and boards' poses and time offsets that fit best, from `start`, and how well.

    Every camera's intrinsics, T_ref_sensor of every sensor but the reference and the time offsets of those
    that have one in `start` are free unless `fixed` names them: ``rgb`` (all intrinsics), ``lidar`` (all it
    has), ``rgb.k3``, ``T_rgb_fir``, ``fir.time_offset_s``. Sensors without data stay as they start; moments
    without any are left out. Sensors are weighted by their noise, which is estimated with them (Förstner
    1979). With `robust`, a Cauchy loss finds the way; then points farther out than five standard deviations
    (by the median) are left out and the rest is plain least squares, so that the covariance is that of
    normal noise. With `drop_views`, views most of whose points do not fit go too, and those whose median
    error is far above the others' (2.5 times, six deviations of the medians, 0.1 px). Distortion coefficients
    have a prior that speaks only where the data do not: each moves the radius in the picture's corner by
    100 % (one standard deviation). `progress(step, most)` is called after each step.

    Raises `InputError` where nothing is left, where the data leave parameters open (it names them), where no
    fit is found or the fit is absurd, and for data that are not finite; `ValueError` for names and ids that
    do not exist.
    """
    check_input(board, views, clouds, start)
    check_fixed(fixed, start)
    chosen = _Chosen(*usable(board, views, clouds, start))
    while True:
        chosen.check_left(views, clouds)
        check_linked(chosen.views, chosen.clouds, start, fixed)
        layout = Layout(start, chosen.sensors(), chosen.moments(), fixed)
        blocks = blocks_of(board, chosen.views, chosen.clouds, layout)
        fit = Descent(blocks, layout, progress).fit(robust)
        gone = chosen.poor(blocks, fit, drop_views)
        if not gone:
            break
        chosen, start = chosen.without(gone), _estimate(layout, fit)
    _check_sense(layout, blocks, fit)
    check_angles(layout, fit.state, blocks)
    check_determined(layout, fit.state, _sober(layout, blocks, fit))
    if not fit.settled:
        raise InputError(
            "the solve does not settle", hint="hold more parameters, or record views that differ"
        )
    return _solution(chosen, blocks, layout, fit)


@dataclass(frozen=True, slots=True)
class _Chosen:
    """What takes part, and what was dropped with the reason."""

    views: list[View]
    clouds: list[CloudView]
    dropped: Dropped

    def sensors(self) -> list[str]:
        return list(dict.fromkeys([*(v.camera for v in self.views), *(c.sensor for c in self.clouds)]))

    def moments(self) -> list[str]:
        return list(dict.fromkeys(v.moment for v in self.views))

    def check_left(self, views: Sequence[View], clouds: Sequence[CloudView]) -> None:
        """`InputError` where a sensor that had views has none any more."""
        had = _Chosen(list(views), list(clouds), []).sensors()
        if lost := [name for name in had if name not in self.sensors()]:
            why = "; ".join(f"{name}: {reason}" for name, reason in self.dropped[:3])
            raise InputError(f"no usable view of {' and '.join(lost)} is left", hint=why)
        if not self.views:
            raise InputError("no views to solve from", hint="record a board that the cameras see")

    def items(self, blocks: Sequence[Block]) -> Iterator[tuple[Block, list[View] | list[CloudView]]]:
        """Each block with the views or clouds that its parts are."""
        for block in blocks:
            if block.kind == "px":
                yield block, [v for v in self.views if v.camera == block.sensor]
            else:
                yield block, [c for c in self.clouds if c.sensor == block.sensor]

    def poor(self, blocks: Sequence[Block], fit: Fit, drop_views: bool) -> dict[int, str]:
        """The views (by id()) that should not take part, and why."""
        gone: dict[int, str] = {}
        for (block, items), r, used in zip(self.items(blocks), fit.r, fit.used, strict=True):
            poor = poor_parts(block, r, used) if drop_views else starved(block, r, used)
            gone |= {id(items[i]): reason for i, reason in poor.items()}
        return gone

    def without(self, gone: Mapping[int, str]) -> _Chosen:
        dropped = [(label(x), gone[id(x)]) for x in (*self.views, *self.clouds) if id(x) in gone]
        views = [v for v in self.views if id(v) not in gone]
        clouds, lost = usable_clouds([c for c in self.clouds if id(c) not in gone], views)
        return _Chosen(views, clouds, self.dropped + dropped + lost)


def _solution(chosen: _Chosen, blocks: Sequence[Block], layout: Layout, fit: Fit) -> Solution:
    by_item: dict[tuple[int, str], tuple[Floats, np.ndarray]] = {}
    for (block, items), r, used in zip(chosen.items(blocks), fit.r, fit.used, strict=True):
        for item, part, mask in zip(items, by_part(block, r), by_part(block, used), strict=True):
            by_item[id(item), block.kind] = part, mask
    nothing = np.zeros((0, 1)), np.zeros(0, bool)
    seen = [by_item[id(v), "px"] for v in chosen.views]
    planes = [by_item[id(c), "plane"] for c in chosen.clouds]
    edges = [by_item.get((id(c), "edge"), nothing) for c in chosen.clouds]
    covariance = inverse(fit.information)
    noise = [(b, s) for b, s in zip(blocks, fit.sigma, strict=True)]
    return Solution(
        estimate=_estimate(layout, fit),
        names=layout.free_names,
        covariance=covariance,
        views=tuple(chosen.views),
        residual_px=tuple(r for r, _ in seen),
        used=tuple(u for _, u in seen),
        sigma_px={b.sensor: s for b, s in noise if b.kind == "px"},
        clouds=tuple(chosen.clouds),
        plane_residual_m=tuple(r[:, 0] for r, _ in planes),
        edge_residual_m=tuple(r[:, 0] for r, _ in edges),
        sigma_m=_pooled(noise, "plane"),
        dropped_views=tuple(chosen.dropped),
        notes=(*poorly_told_apart(layout, covariance), *_outlier_notes(blocks, fit)),
        plane_used=tuple(u for _, u in planes),
        edge_used=tuple(u for _, u in edges),
        sigma_edge_m=_pooled(noise, "edge"),
    )


def _estimate(layout: Layout, fit: Fit) -> Estimate:
    try:
        return layout.estimate(fit.state)
    except UsageError as error:
        hint = "record more, and more different, views"
        raise InputError(f"the solve ran away: {error.what}", hint=hint) from None


def _sober(layout: Layout, blocks: Sequence[Block], fit: Fit) -> Floats:
    """The information as if no camera saw better than 0.01 px: what perfect data leave open is open too."""
    best = min((s for b, s in zip(blocks, fit.sigma, strict=True) if b.kind == "px"), default=1.0)
    share, prior = min(1.0, (best / _LEAST_NOISE_PX) ** 2), np.diag(layout.prior)
    return share * (fit.information - prior) + prior


def _check_sense(layout: Layout, blocks: Sequence[Block], fit: Fit) -> None:
    """`InputError` where the points are so far off that this is not the board, or not the camera."""
    for block, sigma in zip(blocks, fit.sigma, strict=True):
        if block.kind == "px" and sigma > _ABSURD_SHARE * layout.cameras[block.sensor].size_wh[0]:
            hint = "is it this board, this camera's start, and are the points in the right order?"
            raise InputError(f"nothing fits: points of {block.sensor} are {sigma:.0f} px off", hint=hint)


def _pooled(noise: Sequence[tuple[Block, float]], kind: str) -> float | None:
    """One figure for all LiDARs: root of the mean variance."""
    values = [s for block, s in noise if block.kind == kind]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _outlier_notes(blocks: Sequence[Block], fit: Fit) -> list[str]:
    kinds = {"px": "points", "plane": "points on the plane", "edge": "points on the rim"}
    return [
        f"{block.sensor}: {int((~used).sum())} of {len(used)} {kinds[block.kind]} left out as outliers"
        for block, used in zip(blocks, fit.used, strict=True)
        if not used.all()
    ]
