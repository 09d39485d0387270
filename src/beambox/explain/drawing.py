"""Maps in BEV as pictures: x forward is up, y left is left, in metres."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from beambox.geometry import VoxelGrid, corners_bev

__all__ = ["Explained", "draw_bars", "draw_maps", "draw_near", "scatter_map"]


@dataclass(frozen=True)
class Explained:
    """A picture and what it shows."""

    name: str
    """Plain, for a file."""
    caption: str
    picture: Image.Image


def draw_maps(
    maps: Sequence[tuple[str, Tensor]],
    grid: VoxelGrid,
    boxes: Tensor,
    title: str,
    *,
    limits: tuple[float, float] | None = None,
) -> Image.Image:
    """Draw maps side by side.

    Args:
        maps: title and ``(Y, X)`` values of each; NaN is left dark.
        grid: region that they cover.
        boxes: ``(N, 7)``, drawn as outlines.
        title: above all.
        limits: values of the darkest and brightest color; those of all maps where None.
    """
    from matplotlib.figure import Figure

    width = 4.2 * len(maps) + 0.6
    x, y = _shown_part([bev for _, bev in maps], grid)
    tall = 3.9 * (x[1] - x[0]) / (y[1] - y[0])
    figure = Figure(figsize=(width, min(12.0, max(3.4, tall + 1.0))), layout="constrained")
    axes = figure.subplots(1, len(maps), squeeze=False)[0]
    values = np.concatenate([each.numpy().ravel() for _, each in maps])
    values = values[np.isfinite(values)]
    low, high = limits or ((float(values.min()), float(values.max())) if len(values) else (0.0, 1.0))
    shown = None
    for each, (name, bev) in zip(axes, maps):
        extent = (grid.minimum[1], grid.maximum[1], grid.minimum[0], grid.maximum[0])
        shown = each.imshow(
            bev.T.numpy(), origin="lower", extent=extent, vmin=low, vmax=max(high, low + 1e-6), cmap="viridis",
            interpolation="nearest",
        )  # fmt: skip
        each.set_facecolor("#101418")
        _outlines(each, boxes)
        each.set(xlim=(y[1], y[0]), ylim=x, xlabel="y, m")
        each.set_title(name, fontsize=9)
    axes[0].set_ylabel("x, m")
    if shown is not None:
        figure.colorbar(shown, ax=list(axes), fraction=0.03)
    _entitle(figure, title)
    return _picture(figure)


def draw_near(
    items: Sequence[tuple[str, Tensor, NDArray[np.floating], NDArray[np.floating], float]],
    points: Tensor,
    title: str,
    reach: float = 6.0,
) -> Image.Image:
    """Draw values at places around boxes, with the points of the sweep.

    Args:
        items: title, ``(7,)`` box, ``(K, 2)`` x, y of places, ``(K,)`` values, and the edge of a place in metres.
        points: ``(N, 3 or more)``.
        title: above all.
        reach: metres around each box.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.5 * max(1, len(items)) + 0.4, 3.9), layout="constrained")
    axes = figure.subplots(1, max(1, len(items)), squeeze=False)[0]
    for each, (name, box, places, values, edge) in zip(axes, items):
        x, y = float(box[0]), float(box[1])
        near = ((points[:, 0] - x).abs() < reach) & ((points[:, 1] - y).abs() < reach)
        each.set_facecolor("#101418")
        size = (72 * 3.0 * edge / (2 * reach)) ** 2
        dots = each.scatter(places[:, 1], places[:, 0], c=values, s=size, marker="s", cmap="viridis", linewidths=0)
        each.scatter(points[near, 1], points[near, 0], s=1.2, c="white", linewidths=0)
        _outlines(each, box[None])
        each.set(xlim=(y + reach, y - reach), ylim=(x - reach, x + reach), aspect="equal")
        each.set_title(name, fontsize=9)
        figure.colorbar(dots, ax=each, fraction=0.045)
    _entitle(figure, title)
    return _picture(figure)


def _entitle(figure: Any, title: str) -> None:
    """Put a title above all, in as many lines as the figure's width asks for."""
    letters = round(12 * figure.get_figwidth())  # of 10 points, about so many in an inch
    figure.suptitle("\n".join(textwrap.wrap(title, letters)), fontsize=10)


def draw_bars(series: Sequence[tuple[str, Tensor]], title: str, label: str) -> Image.Image:
    """Draw ``(N,)`` values of each series as lines over their number."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for name, values in series:
        axes.step(range(len(values)), values.numpy(), where="mid", label=name, linewidth=1.2)
    axes.set(xlabel=label, ylabel="weight")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8)
    axes.set_title(title, fontsize=10)
    return _picture(figure)


def _shown_part(maps: Sequence[Tensor], grid: VoxelGrid) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return limits of x and y: what is not empty in any of the maps, and 2 m around it."""
    rows, columns = torch.nonzero(torch.stack([bev.isfinite() for bev in maps]).any(dim=0)).unbind(dim=1)
    limits = []
    for axis, at, size in ((0, columns, maps[0].shape[1]), (1, rows, maps[0].shape[0])):
        low, high = grid.minimum[axis], grid.maximum[axis]
        edge = (high - low) / size
        first, last = (float(at.min()), float(at.max())) if len(at) else (0.0, size - 1.0)
        limits.append((max(low, low + first * edge - 2), min(high, low + (last + 1) * edge + 2)))
    return limits[0], limits[1]


def _outlines(axes: Any, boxes: Tensor) -> None:
    for corners in corners_bev(boxes.double()).numpy():
        ring = np.concatenate((corners, corners[:1]))
        axes.plot(ring[:, 1], ring[:, 0], color="#ff9f1c", linewidth=1.0)


def _picture(figure: Any) -> Image.Image:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    return Image.open(stream).convert("RGB")


def scatter_map(values: Tensor, rows: Tensor, columns: Tensor, shape: tuple[int, int]) -> Tensor:
    """Lay values onto a map of (Y, X) cells, the largest where several meet; NaN where there is none."""
    flat = torch.full((shape[0] * shape[1],), -torch.inf)
    flat = flat.scatter_reduce(0, rows * shape[1] + columns, values.float(), "amax")
    return torch.where(flat.isinf(), torch.nan, flat).view(shape)
