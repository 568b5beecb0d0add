"""Charts: what they show, in what colours, and that a missing matplotlib or a bad row is one line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from clsplat import charts
from clsplat.chart_style import chart_paths, drawing, looks, shape_colour, short_count
from clsplat.charts import VERDICTS, growth_chart, heat_map
from clsplat.errors import InputError, OutputError
from clsplat.shapes import SHAPES

CURVE: list[dict[str, Any]] = [{"splats": 4000, "psnr": 21.5}, {"splats": 1000, "psnr": 18.0},
                               {"splats": 9000, "psnr": 21.6}, {"splats": 3000, "psnr": 21.45, "label": "pruned"}]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that are drawn, which are written as well."""
    figures: list[Any] = []
    context = charts.drawing

    class Kept:
        def __init__(self, *arguments: Any) -> None:
            self.context = context(*arguments)

        def __enter__(self) -> Any:
            figures.append(self.context.__enter__())
            return figures[-1]

        def __exit__(self, *error: Any) -> Any:
            return self.context.__exit__(*error)

    monkeypatch.setattr(charts, "drawing", Kept)
    return figures


def words(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_growth_chart(tmp_path: Path, drawn: list[Any]) -> None:
    paths = growth_chart(CURVE, 4000, tmp_path / "growth")
    assert [path.name for path in paths] == ["growth.png", "growth.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in paths[1].read_bytes()[:600]
    (axes,) = drawn[0].axes
    assert list(axes.lines[0].get_xdata()) == [1000, 4000, 9000], "the curve rises and has no named points"
    legend = [text.get_text() for text in axes.get_legend().texts]
    assert legend == ["growth", "knee: 4k splats, 21.50 dB", "pruned: 3k splats, 21.45 dB"]
    assert "[dB]" in axes.get_ylabel()


def test_charts_are_the_same_bytes(tmp_path: Path) -> None:
    first, second = (growth_chart(CURVE, None, tmp_path / name) for name in "ab")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_a_knee_lies_on_the_curve(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="knee"):
        growth_chart(CURVE, 3000, tmp_path / "growth")
    with pytest.raises(InputError, match="needs a curve"):
        growth_chart([], None, tmp_path / "growth")
    assert not list(tmp_path.iterdir())


def test_heat_map(tmp_path: Path, drawn: list[Any]) -> None:
    cells = [{"row": "needles", "column": "gaussian", "verdict": "survives", "text": "+0.1"},
             {"row": "needles", "column": "student-t", "verdict": "loses", "text": "-1.2"},
             {"row": "one image", "column": "gaussian", "verdict": "fails", "text": "NaN"}]
    heat_map(cells, tmp_path / "heat")
    (axes,) = drawn[0].axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["needles", "one image", "survived"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["gaussian", "student-t"]
    assert words(axes) == ["+0.1", "-1.2", "NaN", "", "1/2", "0/1"], "a place without a cell counts nowhere"
    legend = [text.get_text() for text in drawn[0].legends[0].texts]
    assert legend == ["survives", "loses", "fails"]
    with pytest.raises(InputError, match="unknown verdict 'maybe'"):
        heat_map([cells[0] | {"verdict": "maybe"}], tmp_path / "heat")


def test_colours_are_told_apart() -> None:
    colours = [shape_colour(shape) for shape in SHAPES]
    assert len(set(colours)) == len(SHAPES)
    assert len({fill for fill, _ in VERDICTS.values()}) == len(VERDICTS)
    shapes = list(SHAPES)
    styles = looks({"a": shapes[0], "b": shapes[0], "c": shapes[1]})
    assert styles["a"]["color"] == styles["b"]["color"] != styles["c"]["color"]
    assert styles["a"]["linestyle"] != styles["b"]["linestyle"]
    assert styles["a"]["marker"] != styles["c"]["marker"]


def test_short_counts() -> None:
    assert [short_count(n) for n in (7, 950, 1000, 2500, 20_000, 999_900, 3e6)] == [
        "7", "950", "1k", "2.5k", "20k", "1M", "3M"]  # fmt: skip


def test_suffixes_are_taken_off_once() -> None:
    assert [path.name for path in chart_paths("a/fox.v2")] == ["fox.v2.png", "fox.v2.svg"]
    assert [path.name for path in chart_paths("a/fox.svg")] == ["fox.png", "fox.svg"]


def test_a_missing_matplotlib_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(OutputError, match=r"pip install 'clsplat\[charts\]'"):
        growth_chart(CURVE, None, tmp_path / "growth")


def test_an_unfinished_drawing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), drawing(tmp_path / "half"):
        _ = 1 / 0
    assert not list(tmp_path.iterdir())
