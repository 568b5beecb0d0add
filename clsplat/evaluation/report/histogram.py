"""The distribution of errors between renders and photos, as inlined SVG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...files.html_page import escape
from ..chart_style import category_colour

# First and last error of each bar, in steps of 8 bits. The bars double, because errors spread over decades.
BINS = ((0, 0), (1, 1), (2, 2), (3, 4), (5, 8), (9, 16), (17, 32), (33, 64), (65, 128), (129, 255))
_WIDTH, _HEIGHT = 640, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 8, 12, 40


def shares(counts: NDArray[np.int64]) -> list[float]:
    """Share of the values in each of BINS [%].

    Parameters
    ----------
    counts : (256,) number of values by error.
    """
    total = max(int(counts.sum()), 1)
    return [100.0 * float(counts[first : last + 1].sum()) / total for first, last in BINS]


def quantile(counts: NDArray[np.int64], share: float) -> int:
    """The error that a share (0..1) of the values does not exceed, in steps of 8 bits."""
    return int(np.searchsorted(np.cumsum(counts), share * counts.sum()))


def histogram(labels: Sequence[str], counts: Sequence[NDArray[np.int64]]) -> str:
    """HTML of a figure with bars for each model, and a legend if there are several.

    Parameters
    ----------
    labels : of the models.
    counts : (256,) number of values by error, for each model.
    """
    by_model = [shares(of_model) for of_model in counts]
    top = _ceiling(max(max(of_model) for of_model in by_model))
    wide, high = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    step = wide / len(BINS)
    bar = 0.8 * step / len(labels)
    parts = []
    for tick in range(5):
        share = top * tick / 4
        y = _TOP + high * (1 - tick / 4)
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{share:g} %</text>'
        )
    for place, (first, last) in enumerate(BINS):
        name = str(first) if first == last else f"{first}–{last}"
        middle = _LEFT + (place + 0.5) * step
        parts.append(f'<text x="{middle:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{name}</text>')
        for model, (label, of_model) in enumerate(zip(labels, by_model, strict=True)):
            tall = high * of_model[place] / top
            parts.append(
                f'<rect x="{_LEFT + (place + 0.1) * step + model * bar:.1f}" y="{_TOP + high - tall:.1f}" '
                f'width="{bar:.1f}" height="{tall:.1f}" fill="{category_colour(model)}">'
                f"<title>{escape(label)}: {of_model[place]:.1f} % differ by {name}</title></rect>"
            )
    parts.append(
        f'<text x="{_LEFT + wide / 2:.0f}" y="{_HEIGHT - 6}" text-anchor="middle">absolute error, steps of 255</text>'
    )
    description = f"Bar chart of errors: {'; '.join(map(_described, labels, counts))}"
    drawing = (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(description)}">'
        + "".join(parts)
        + "</svg>"
    )
    return f'<figure class="histogram">{drawing}{_legend(labels) if len(labels) > 1 else ""}</figure>\n'


def _described(label: str, counts: NDArray[np.int64]) -> str:
    return (
        f"{label}: half of the values are within {quantile(counts, 0.5)}, 95 % within {quantile(counts, 0.95)} of 255"
    )


def _legend(labels: Sequence[str]) -> str:
    keys = "".join(
        f'<span><i style="background:{category_colour(place)}"></i>{escape(label)}</span>'
        for place, label in enumerate(labels)
    )
    return f"<figcaption>{keys}</figcaption>"


def _ceiling(share: float) -> float:
    """The next round percentage that four divides."""
    tops = (4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 32.0, 40.0, 60.0, 80.0, 100.0)
    return next(top for top in tops if top >= min(share, 100.0))
