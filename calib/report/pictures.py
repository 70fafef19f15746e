"""The report's pictures as PNG bytes: residuals, coverage, uncertainty, thermal edges on RGB."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.evidence.coverage import Coverage, unseen_mask
from calib.evidence.linear import board_pose
from calib.evidence.uncertainty import UncertaintyMap
from calib.solve.estimate import Solution
from fusion.geometry import Floats, invert, transform

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ARROW = 0.04  # of the image's width: what the picture's longest typical residual is drawn as


def residual_picture(solution: Solution, camera: str) -> bytes:
    """Every residual as an arrow where it is, and all of them around zero; outliers in red."""
    views = [
        (v.uv, r, used)
        for v, r, used in zip(solution.views, solution.residual_px, solution.used, strict=True)
        if v.camera == camera
    ]
    uv, error, used = (np.concatenate(part) for part in zip(*views, strict=True))
    w, h = solution.estimate.cameras[camera].size_wh

    def draw(image: Axes, around: Axes) -> None:
        typical = max(float(np.percentile(np.linalg.norm(error[used], axis=1), 95)), 1e-9)
        longer = _ARROW * w / typical
        for chosen, colour in ((used, "tab:blue"), (~used, "tab:red")):
            ends = uv[chosen] + longer * np.clip(error[chosen], -3 * typical, 3 * typical)
            image.plot(*_segments(uv[chosen], ends), color=colour, linewidth=0.8)
            around.scatter(*error[chosen].T, s=4, color=colour, linewidths=0)
        _image_axes(image, (w, h), f"residuals, {longer:.0f} times as long")
        reach = 4 * typical / 2
        around.set(
            xlim=(-reach, reach), ylim=(reach, -reach), xlabel="px right", ylabel="px down", aspect="equal"
        )
        around.set_title(
            f"rms {solution.rms_px(camera):.3f} px, {int((~used).sum())} of {len(used)} left out"
        )
        around.grid(alpha=0.3)

    return _figure(2, draw, f"{camera}: residuals")


def coverage_picture(solution: Solution, covered: Coverage) -> bytes:
    """How many points were seen in each part of the image; tilt and distance of every view."""
    w, h = solution.estimate.cameras[covered.camera].size_wh

    def draw(image: Axes, views: Axes) -> None:
        shown = image.imshow(
            covered.cells, extent=(-0.5, w - 0.5, h - 0.5, -0.5), cmap="viridis", aspect="equal"
        )
        for view in solution.views:
            if view.camera == covered.camera:
                image.scatter(*view.uv.T, s=1.5, color="white", linewidths=0)
        _image_axes(image, (w, h), f"points a cell; {covered.share:.0%} of the cells have some")
        image.figure.colorbar(shown, ax=image, shrink=0.7)
        views.scatter(covered.distance_m, covered.tilt_deg, s=12)
        views.set(
            xlabel="distance, m", ylabel="tilt, degrees", ylim=(0, 90), title=f"{len(covered.tilt_deg)} views"
        )
        views.set_xlim(left=0)
        views.grid(alpha=0.3)

    return _figure(2, draw, f"{covered.camera}: coverage")


def uncertainty_picture(found: UncertaintyMap, solution: Solution, seen_in: str) -> bytes:
    """A map of the standard deviation; crosses where no point was seen."""
    w, h = found.size_wh
    unseen = unseen_mask(solution, seen_in, found.sigma_px.shape[::-1])

    def draw(image: Axes) -> None:
        top = max(float(np.nanpercentile(found.sigma_px, 98)), 1e-6)
        shown = image.imshow(
            found.sigma_px,
            extent=(-0.5, w - 0.5, h - 0.5, -0.5),
            cmap="magma",
            vmin=0,
            vmax=top,
            aspect="equal",
        )
        if found.size_wh == solution.estimate.cameras[seen_in].size_wh:
            image.scatter(*found.uv[unseen].T, marker="x", s=12, color="white", linewidths=0.6)
        if np.isfinite(found.sigma_px).all() and np.ptp(found.sigma_px) > 0:
            lines = image.contour(
                found.uv[..., 0], found.uv[..., 1], found.sigma_px, 5, colors="white", linewidths=0.6
            )
            image.clabel(lines, fontsize=7)
        _image_axes(image, (w, h), f"median {found.median_px:.2f}, worst {found.worst_px:.2f} px")
        image.figure.colorbar(shown, ax=image, shrink=0.7, label="standard deviation, px")

    far = "far away" if found.distance_m > 1e4 else f"at {found.distance_m:.1f} m"
    return _figure(1, draw, f"{found.of}: uncertainty {far}")


def board_overlay(
    solution: Solution,
    moment: str,
    dst: tuple[str, NDArray[Any]],
    src: tuple[str, NDArray[Any]],
) -> NDArray[np.uint8]:
    """The picture of camera `dst`, darkened, with the edges of the picture of `src` as they fall on the
    board's plane.

    `dst` and `src` are (camera, H x W [x 3] uint8 or uint16). Exact on the board; what lies before or
    behind it is off by parallax.
    """
    at, mask = plane_map(solution, moment, dst[0], src[0])
    base = np.asarray(to_bgr(dst[1]) * 0.7, np.uint8)
    grey = cv2.cvtColor(to_bgr(src[1]), cv2.COLOR_BGR2GRAY)
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.2), 40, 110)
    carried = cv2.remap(edges, at.astype(np.float32), None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    base[(carried > 60) & mask] = (60, 60, 255)
    views = {v.camera: v for v in solution.views if v.moment == moment}
    if dst[0] in views:
        for u, v in views[dst[0]].uv:
            cv2.circle(base, (round(u), round(v)), 3, (80, 255, 80), 1, cv2.LINE_AA)
    return base


def plane_map(solution: Solution, moment: str, dst: str, src: str) -> tuple[Floats, NDArray[np.bool_]]:
    """For every pixel of `dst`, the pixel of `src` that sees the same point of the board's plane (H x W x
    2), and whether one does."""
    estimate = solution.estimate
    w, h = estimate.cameras[dst].size_wh
    u, v = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    rays = estimate.cameras[dst].unproject(np.stack([u.ravel(), v.ravel()], -1))
    T = board_pose(estimate, moment, dst)
    normal, point = T[:3, 2], T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (normal @ point) / (rays @ normal)
        at_ref = transform(estimate.T_ref_sensor[dst], rays * away[:, None])
        at, seen = estimate.cameras[src].project(transform(invert(estimate.T_ref_sensor[src]), at_ref))
        seen = seen & (away > 0) & np.isfinite(at).all(1)
    at = np.where(seen[:, None], at, -1.0)
    return at.reshape(h, w, 2), seen.reshape(h, w)


def to_bgr(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Any picture as BGR uint8; 16 bits stretched between their 1st and 99th percentile."""
    if image.dtype != np.uint8:
        low, high = np.percentile(image, (1, 99))
        image = np.clip((image - low) / max(high - low, 1) * 255, 0, 255).astype(np.uint8)
    bgr = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    return np.asarray(bgr, np.uint8)


def _segments(starts: Floats, ends: Floats) -> tuple[Floats, Floats]:
    """Lines as two lists with gaps, which draws thousands at once."""
    gap = np.full(len(starts), np.nan)
    x, y = (np.stack([starts[:, i], ends[:, i], gap], 1).ravel() for i in (0, 1))
    return x, y


def _image_axes(axes: Axes, size_wh: tuple[int, int], title: str) -> None:
    axes.set(xlim=(-0.5, size_wh[0] - 0.5), ylim=(size_wh[1] - 0.5, -0.5), aspect="equal", title=title)


def _figure(columns: int, draw: Callable[..., None], title: str) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6 * columns, 4.4), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    draw(*np.ravel(figure.subplots(1, columns, squeeze=False)))
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()
