"""Charts: data, colours, and messages of one line if matplotlib is missing or a row is invalid."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from sweep_records import length_records, run_record, seed_records, sweep_records

from clsplat.comparison import charts, search_chart, sweep_charts
from clsplat.comparison.charts import arithmetic_chart, seeds_chart
from clsplat.comparison.length_rows import length_rows
from clsplat.comparison.search_chart import draw_search, rounds_chart
from clsplat.comparison.sweep_charts import equal_chart, length_chart, size_chart, time_chart
from clsplat.comparison.sweep_rows import arithmetic_rows, curve_rows, equal_rows, point_rows, seed_rows
from clsplat.comparison.sweep_tables import arithmetic_table
from clsplat.errors import InputError, OutputError
from clsplat.evaluation.chart_style import _STYLE, chart_paths, drawing, looks, place_labels, shape_colour, short_count
from clsplat.splats.shapes import SHAPES


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Collect the drawn figures. They are also written, at a small size."""
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

    for module in (charts, search_chart, sweep_charts):
        monkeypatch.setattr(module, "drawing", Kept)
    monkeypatch.setitem(_STYLE, "savefig.dpi", 40)
    return figures


def words(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.texts]


def legend_of(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.legends[0].texts]


def search_report() -> dict[str, Any]:
    rows = [(9000, [20.0, 23.0]), (6750, [20.1, 23.1]), (5062, [19.0, 22.4])]
    return {
        "rounds": [{"splats": n, "psnr": sum(views) / 2, "views": views} for n, views in rows],
        "chosen": 1,
        "held_out": {"splats": 6750, "psnr_pruned": 21.55},
    }


def test_rounds_chart(tmp_path: Path, drawn: list[Any]) -> None:
    paths = rounds_chart(search_report(), tmp_path / "rounds")
    assert [path.name for path in paths] == ["rounds.png", "rounds.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in paths[1].read_bytes()[:600]
    (axes,) = drawn[0].axes
    (curve, _, (bars,)) = axes.containers[0]
    assert (list(curve.get_xdata()), list(curve.get_ydata())) == ([9000, 6750, 5062], pytest.approx([21.5, 21.6, 20.7]))
    heights = [segment[1][1] - segment[0][1] for segment in bars.get_segments()]
    assert heights == pytest.approx([0, 0, 2 * 0.2]), "losses of 1.1 and 0.7 dB: their standard error is 0.2"
    legend = [text.get_text() for text in axes.get_legend().texts]
    assert legend == ["chosen: 6.75k splats, 21.60 dB", "without parts: 6.75k splats, 21.55 dB", "rounds of pruning"]
    assert "[dB]" in axes.get_ylabel()


def test_charts_are_the_same_bytes(tmp_path: Path, drawn: list[Any]) -> None:
    first, second = (rounds_chart(search_report(), tmp_path / name) for name in "ab")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_size_chart(tmp_path: Path, drawn: list[Any]) -> None:
    rows = point_rows(sweep_records())
    size_chart(rows, tmp_path / "size")
    render, size, splats = drawn[0].axes
    assert [axes.get_xlabel() for axes in (render, size, splats)] == ["render time [ms]", "file [MB]", "splats"]
    assert legend_of(drawn[0]) == ["gaussian", "default", "half-gaussian"]
    front, gaussian, default, single = splats.lines
    assert list(front.get_xdata()) == [1000, 1500, 4000]
    assert front.get_drawstyle() == "steps-post"
    assert (list(gaussian.get_xdata()), list(gaussian.get_ydata())) == ([1000, 2000, 4000], [20, 21, 22])
    assert list(single.get_xdata()) == [1500]
    assert gaussian.get_color() == shape_colour("gaussian") != default.get_color()
    assert list(size.lines[1].get_xdata()) == pytest.approx([0.2, 0.4, 0.8])
    assert set(words(splats)) == {"1k", "1.5k", "4k"}, "the front is labelled, all else is not"


def test_time_chart(tmp_path: Path, drawn: list[Any]) -> None:
    runs = [
        run_record("gaussian", curve=sweep_records()[0]["curve"]),
        run_record("3dgs", curve=sweep_records()[1]["curve"]),
    ]
    time_chart(curve_rows(runs), tmp_path / "time")
    psnr, ssim = drawn[0].axes
    assert (psnr.get_ylabel(), ssim.get_ylabel(), ssim.get_xlabel()) == (
        "test PSNR [dB]",
        "test SSIM",
        "training time [s]",
    )
    assert list(psnr.lines[0].get_xdata()) == [0.1, 0.4, 2.0, 10.0]
    assert list(ssim.lines[1].get_ydata()) == [row["ssim"] for row in runs[1]["curve"]]
    assert psnr.lines[0].get_color() == psnr.lines[1].get_color(), "one shape"
    assert psnr.lines[0].get_linestyle() != psnr.lines[1].get_linestyle()
    best = max(row["psnr"] for row in runs[1]["curve"])
    assert best - 5.2 < psnr.get_ylim()[0] < best - 1 < best < psnr.get_ylim()[1]


def test_length_chart(tmp_path: Path, drawn: list[Any]) -> None:
    length_chart(length_rows(length_records()), tmp_path / "length")
    psnr, ssim = drawn[0].axes
    assert ssim.get_xlabel() == "training time [s]"
    front, gaussian, default = psnr.lines
    assert list(front.get_xdata()) == [1.0, 2.0, 4.0, 8.0]
    assert (list(gaussian.get_xdata()), list(gaussian.get_ydata())) == ([1.0, 2.0, 4.0], [20.0, 21.0, 22.0])
    assert list(default.get_ydata()) == [21.5, 22.5, 23.5]
    assert len(ssim.lines) == 2, "the front is that of PSNR"
    assert psnr.get_title() == "yard 8x6,\ncap 1k"


def test_equal_chart(tmp_path: Path, drawn: list[Any]) -> None:
    equal_chart(equal_rows(point_rows(sweep_records()), "gaussian"), "gaussian", tmp_path / "equal")
    (axes,) = drawn[0].axes
    reached, bound = axes.lines[:2]
    assert list(reached.get_xdata()) == [2000, 4000]
    assert list(reached.get_ydata()) == pytest.approx([100 / 2**0.5] * 2)
    assert (list(bound.get_xdata()), bound.get_markerfacecolor()) == ([1000], "white")
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log"
    assert low < 100 / 2**0.5 < 100 < high
    out_of_reach = [row for row in equal_rows(point_rows(sweep_records()), "default") if row["ratio"] is None]
    with pytest.raises(InputError, match="needs points"):
        equal_chart(out_of_reach, "default", tmp_path / "none")


def test_seeds_chart(tmp_path: Path, drawn: list[Any]) -> None:
    rows = seed_rows(seed_records())
    rows[-1] |= {"psnr": 20.5, "digest": "another"}
    seeds_chart(rows, tmp_path / "seeds")
    (axes,) = drawn[0].axes
    assert [label.get_text() for label in axes.get_xticklabels()] == [
        "gaussian\nseeds 0.40 dB\nrepeats 0.00 dB",
        "3dgs\nseeds 0.40 dB\nrepeats 0.50 dB",
    ]
    assert words(axes) == ["=", "≠"]
    dots, median, repeats = axes.lines[:3]
    assert sorted(dots.get_ydata()) == pytest.approx([20.0, 20.1, 20.2, 20.3, 20.4])
    assert list(median.get_ydata()) == [20.2, 20.2]
    assert list(repeats.get_ydata()) == [20.0] * 3
    with pytest.raises(InputError, match="several seeds"):
        seeds_chart([], tmp_path / "none")


def test_arithmetic_chart(tmp_path: Path, drawn: list[Any]) -> None:
    records = [
        {
            "scene": scene,
            "variant": variant,
            "kind": kind,
            "shape": shape,
            "image_error": error * worse,
            "gradient_error": 10 * error * worse,
            "raster_ms": ms * slow,
            "raster_vjp_ms": 3 * ms * slow,
            "psnr_change": -0.1 * worse,
        }
        for scene, slow, worse in (("near", 1.0, 0.5), ("far", 7.0, 2.0))
        for shape, ms in (("gaussian", 5.0), ("skew-normal", 8.0))
        for variant, kind, error, ms in (
            ("erfc", "Phi", 1e-7, 2 * ms),
            ("default", "default", 1e-6, ms),
            ("double", "exact", 0.0, 4 * ms),
        )
    ]
    models = [
        {
            "scene": "near",
            "shape": "skew-normal",
            "variant": "normalisation pdf",
            "kind": "normalisation",
            "image_error": None,
            "gradient_error": None,
            "psnr_change": 0.25,
        }
    ]
    rows = arithmetic_rows([*records, *models])
    arithmetic_chart(rows, tmp_path / "arithmetic")
    assert [axes.get_title() for axes in drawn[0].axes] == ["gaussian", "gaussian", "skew-normal", "skew-normal"]
    for axes, scale in zip(drawn[0].axes, (1, 10, 1, 10), strict=True):
        marked = [line for line in axes.lines if line.get_marker() != "None"]
        assert [line.get_xdata()[0] for line in marked] == pytest.approx([1, 2]), "of its own scene and shape's default"
        assert [line.get_ydata()[0] for line in marked] == pytest.approx([1e-6 * scale, 1e-7 * scale])
        assert sorted(words(axes)) == ["default", "erfc"], "every variant is named, what is exact has no place"
    assert sorted(legend_of(drawn[0])) == ["Phi", "default", "exact"]
    head, lines = arithmetic_table(rows)
    assert {len(line) for line in lines} == {len(head)}
    assert lines[0] == ("gaussian", "erfc", "2", "1.0e-07", "1.0e-06", "2.00", "2.00", "-0.125")
    assert lines[-1] == ("skew-normal", "normalisation pdf", "1", "", "", "", "", "+0.250")


def test_labels_keep_clear_of_points_and_of_each_other(tmp_path: Path) -> None:
    with drawing(tmp_path / "labels", 2, 2) as figure:
        axes = figure.add_subplot(xlim=(0, 1), ylim=(0, 1))
        places = [(0.5 + 0.01 * n, 0.5 + 0.01 * n) for n in range(12)]
        axes.plot(*zip(*places, strict=True), marker="o", linestyle="none")
        points = [(x, y, "label", "black") for x, y in places]
        place_labels(figure, [(axes, points)])
        few = list(axes.texts)
        boxes = [text.get_window_extent() for text in few]
        assert 0 < len(few) < len(points)
        assert not any(a.overlaps(b) for n, a in enumerate(boxes) for b in boxes[:n])
        assert not any(box.contains(*axes.transData.transform(place)) for box in boxes for place in places)


def test_colours_are_told_apart() -> None:
    colours = [shape_colour(shape) for shape in SHAPES]
    assert len(set(colours)) == len(SHAPES)
    shapes = list(SHAPES)
    styles = looks({"a": shapes[0], "b": shapes[0], "c": shapes[1]})
    assert styles["a"]["color"] == styles["b"]["color"] != styles["c"]["color"]
    assert styles["a"]["linestyle"] != styles["b"]["linestyle"]
    assert styles["a"]["marker"] != styles["c"]["marker"]


def test_short_counts() -> None:
    assert [short_count(n) for n in (7, 950, 1000, 2500, 20_000, 999_900, 3e6)] == [
        "7",
        "950",
        "1k",
        "2.5k",
        "20k",
        "1M",
        "3M",
    ]


def test_suffixes_are_taken_off_once() -> None:
    assert [path.name for path in chart_paths("a/fox.v2")] == ["fox.v2.png", "fox.v2.svg"]
    assert [path.name for path in chart_paths("a/fox.svg")] == ["fox.png", "fox.svg"]


def test_a_missing_matplotlib_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(OutputError, match=r"pip install 'clsplat\[charts\]'"):
        rounds_chart(search_report(), tmp_path / "rounds")
    assert draw_search(search_report(), tmp_path) == [], "a search without a chart is a search"


def test_an_unfinished_drawing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), drawing(tmp_path / "half"):
        _ = 1 / 0
    assert not list(tmp_path.iterdir())
