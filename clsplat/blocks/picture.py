"""A picture of a partition from above: cells, points of the scene, and cameras in the colour of their block."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..files.atomic import atomic_writer
from ..scenes.scene import Scene
from ..splats.fields import DoubleArray
from .partition import Partition

SIZE, MARGIN, POINTS = 720, 20, 1500  # px; number of points that are drawn
COLORS = ("#3b6fb6", "#c7372f", "#3a8f4d", "#b8860b", "#7b4fa3", "#2a9d9d", "#d6457f", "#6b6b6b")
_SHOWN = 0.98  # part of the points that the picture contains


def write_picture(path: Path, scene: Scene, partition: Partition) -> None:
    """Write the picture as an SVG file. It shows the axes of the cells; their first axis points to the right."""
    axes = partition.cells.axes
    cameras = np.array([view.camera.position for view in scene.train]) @ axes.T
    points = scene.points.xyz
    points = points[:: -(-len(points) // POINTS)] if len(points) else points
    flat, cells = points @ axes.T, partition.cells.of(points)
    low, high = _frame(cameras, flat)
    scale = (SIZE - 2 * MARGIN) / max(float((high - low).max()), 1e-9)
    width, height = np.ceil((high - low) * scale).astype(int) + 2 * MARGIN

    def place(at: DoubleArray) -> tuple[float, float]:
        x, y = np.clip((at - low) * scale, -1e5, 1e5)
        return MARGIN + float(x), float(height) - MARGIN - float(y)

    def color(block: int) -> str:
        return COLORS[block % len(COLORS)]

    parts = [f'<rect width="{width}" height="{height}" fill="#ffffff"/>']
    for at, block in zip(flat, cells, strict=True):
        x, y = place(at)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.2" fill="{color(int(block))}" fill-opacity="0.45"/>')
    bounds = [low[0], *np.clip(partition.cells.columns, low[0], high[0]), high[0]]
    for column, rows in enumerate(partition.cells.rows):
        borders = [low[1], *np.clip(rows, low[1], high[1]), high[1]]
        for row in range(len(borders) - 1):
            left, top = place(np.array([bounds[column], borders[row + 1]]))
            right, bottom = place(np.array([bounds[column + 1], borders[row]]))
            block = partition.blocks[column * (len(borders) - 1) + row]
            parts.append(
                f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" '
                'fill="none" stroke="#222222"/>'
            )
            parts.append(
                f'<text x="{left + 6:.1f}" y="{top + 16:.1f}" font-size="13" fill="{color(block.number)}">'
                f"block {block.number}: {len(block.views)} photos, {block.splats} splats</text>"
            )
    home = _home(scene, partition)
    for at, block in zip(cameras, home, strict=True):
        x, y = place(at)
        parts.append(
            f'<path d="M{x:.1f},{y - 6:.1f} l5,9 l-10,0 z" fill="{color(block)}" stroke="#222222" stroke-width="0.6"/>'
        )
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="Helvetica, Arial, sans-serif">\n' + "\n".join(parts) + "\n</svg>\n"
    )
    with atomic_writer(path) as stream:
        stream.write(text.encode())


def _frame(cameras: DoubleArray, points: DoubleArray) -> tuple[DoubleArray, DoubleArray]:
    """Return the corners of what is shown: all cameras, and the points without the farthest ones."""
    low, high = cameras.min(axis=0), cameras.max(axis=0)
    if len(points):
        outside = 50.0 * (1.0 - _SHOWN)
        first, last = np.percentile(points, [outside, 100.0 - outside], axis=0)
        low, high = np.minimum(low, first), np.maximum(high, last)
    room = 0.05 * np.maximum(high - low, 1e-9)
    return low - room, high + room


def _home(scene: Scene, partition: Partition) -> list[int]:
    """Return for each training view the block that fills most of it."""
    best = {view.name: (0.0, 0) for view in scene.train}
    for block in partition.blocks:
        for name, share in zip(block.views, block.shares, strict=True):
            best[name] = max(best[name], (share, block.number))
    return [best[view.name][1] for view in scene.train]
