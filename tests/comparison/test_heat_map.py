"""The picture of benchmarks/stability.py shows each verdict and the number of survivors."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from clsplat.errors import InputError
from clsplat.evaluation.chart_style import _STYLE, drawing

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from hazards import heat_map


def test_heat_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures: list[Any] = []

    @contextmanager
    def kept(*arguments: Any) -> Iterator[Any]:
        with drawing(*arguments) as figure:
            figures.append(figure)
            yield figure

    monkeypatch.setattr(heat_map, "drawing", kept)
    monkeypatch.setitem(_STYLE, "savefig.dpi", 40)
    cells = [
        {"row": "needles", "column": "gaussian", "verdict": "survives", "text": "+0.1"},
        {"row": "needles", "column": "student-t", "verdict": "loses", "text": "-1.2"},
        {"row": "one image", "column": "gaussian", "verdict": "fails", "text": "NaN"},
    ]
    heat_map.heat_map(cells, tmp_path / "heat")
    (axes,) = figures[0].axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["needles", "one image", "survived"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["gaussian", "student-t"]
    assert [text.get_text() for text in axes.texts] == ["+0.1", "-1.2", "NaN", "", "1/2", "0/1"], (
        "a place without a cell counts nowhere"
    )
    assert [text.get_text() for text in figures[0].legends[0].texts] == ["survives", "loses", "fails"]
    with pytest.raises(InputError, match="unknown verdict 'maybe'"):
        heat_map.heat_map([cells[0] | {"verdict": "maybe"}], tmp_path / "heat")
    assert len({fill for fill, _ in heat_map.VERDICTS.values()}) == len(heat_map.VERDICTS)
