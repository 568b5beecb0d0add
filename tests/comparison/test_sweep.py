"""Sweeps: charts show what the runs measured, and every run is done once."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from sweep_records import curve_points, length_records, run_record, seed_records, sweep_records

from clsplat.comparison import compare as compare_module
from clsplat.comparison.length_rows import equal_time_rows, length_rows, quality_at, with_shared_seeds
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.runs import RunFile, read_runs
from clsplat.comparison.sweep import sweep, write_report
from clsplat.comparison.sweep_rows import (
    curve_rows,
    equal_rows,
    pareto,
    point_rows,
    seed_rows,
    splats_needed,
    write_rows,
)
from clsplat.comparison.sweep_tables import equal_table, equal_time_table, seed_table
from clsplat.comparison.table import Record, notes, summarise
from clsplat.errors import InputError, OutputError
from clsplat.evaluation import chart_style
from clsplat.files.html_page import Section, write_page
from clsplat.scenes.scene import load_scene


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable matplotlib to save time, if a test needs only the data."""
    monkeypatch.setattr(chart_style, "available", lambda: False)


# --- charts ------------------------------------------------------------------------------------


def test_pareto_keeps_what_nothing_beats() -> None:
    assert pareto([(1, 20), (2, 21), (2, 22), (3, 21.5), (4, 22), (5, 23)]) == {0, 2, 5}
    assert pareto([(2, 20), (1, 20), (1, 20)]) == {1}, "of equal points the first"
    assert pareto([]) == set()


def test_quality_in_equal_time_is_linear_in_log_seconds() -> None:
    line = [(4.0, 22.0), (1.0, 20.0), (2.0, 21.0)]
    assert quality_at(line, 2**0.5) == pytest.approx(20.5)
    assert quality_at(line, 2.0) == pytest.approx(21.0)
    assert (quality_at(line, 1.0), quality_at(line, 4.0)) == (20.0, 22.0)
    assert quality_at(line, 0.99) is None, "all runs are longer"
    assert quality_at(line, 4.01) is None, "all runs are shorter"
    assert quality_at([], 1.0) is None


def test_a_cost_that_was_not_measured_has_no_point() -> None:
    records = [record | {"render_ms": None} for record in sweep_records()]
    rows = point_rows(records)
    assert len(rows) == len(point_rows(sweep_records()))
    assert not any(row["front_render_ms"] for row in rows)
    assert any(row["front_bytes"] for row in rows)
    assert {row["render_ms"] for row in rows} == {None}


def test_runs_of_several_lengths() -> None:
    """The cap with most systems counts. A run of one length and a failed run are left out."""
    others = [
        run_record("gaussian", 2000, 25.0, iterations=100),
        run_record("gaussian", 2000, 26.0, iterations=200),
        run_record("3dgs", 1000, 25.0, iterations=100),
        run_record("default", 1000, 0.0, iterations=800, shape="skew-normal", failed="no memory")
        | {"psnr": None, "ssim": None},
        run_record("gaussian", 1000, 30.0, iterations=100, scene="attic"),
    ]
    rows = length_rows([*length_records(), *others])
    assert {(row["scene"], row["cap"]) for row in rows} == {("yard 8x6", 1000)}
    assert [(row["system"], row["iterations"]) for row in rows] == [
        (system, n) for n in (100, 200, 400) for system in ("gaussian", "default")
    ]
    # 1 s: 20 dB. 2 s: 21 and 21.5. 4 s: 22 and 22.5. 8 s: 23.5.
    assert [row["front"] for row in rows] == [True, True, False, True, False, True]
    assert length_rows(sweep_records()) == []


def test_runs_of_several_lengths_have_the_seeds_of_all_lengths() -> None:
    more = [run_record("default", 1000, 30.0, 1, iterations=n, shape="skew-normal") for n in (100, 200)]
    lengths = length_records()
    assert with_shared_seeds([*lengths, *more]) == lengths, "400 iterations have no seed 1"
    third = run_record("default", 1000, 30.0, 1, iterations=400, shape="skew-normal")
    rows = length_rows([*lengths, *more, third])
    assert {row["seeds"] for row in rows if row["system"] == "default"} == {2}
    assert {row["seeds"] for row in rows if row["system"] == "gaussian"} == {1}
    apart = [run_record("3dgs", 500, 20.0, seed, iterations=n) for seed, n in ((0, 100), (1, 200))]
    assert with_shared_seeds(apart) == apart, "no seed has both lengths"


def test_a_system_that_decides_by_the_length_is_one_system() -> None:
    """Short runs have Gaussians by default, longer ones skew-normals. The reference of the charts is "default"."""
    shapes = {100: "gaussian", 200: "gaussian", 400: "skew-normal"}
    decided = [
        run_record("default", cap, 20.0 + n / 100, shape=shapes[n], iterations=n) for cap in (500, 1000) for n in shapes
    ]
    others = [run_record("3dgs", cap, 19.0 + n / 100, iterations=n) for cap in (500, 1000) for n in shapes]
    records = [*decided, *others]
    assert {row["system"] for row in summarise(records)} == {"default", "3dgs"}
    rows = length_rows(records)
    assert [row["iterations"] for row in rows if row["system"] == "default"] == [100, 200, 400]
    assert {row["system"] for row in equal_rows(point_rows(records), "default")} == {"3dgs"}
    short = run_record("default", 1000, 30.0, 1, shape="gaussian", iterations=100)
    assert short not in with_shared_seeds([*records, short]), "the longest has no seed 1"


def test_points_of_equally_frequent_lengths_are_of_the_longest() -> None:
    records = [
        run_record("gaussian", cap, 20.0 + n / 100, iterations=n) for n in (100, 400, 200) for cap in (500, 1000)
    ]
    assert {row["iterations"] for row in point_rows(records)} == {400}
    more = run_record("3dgs", 500, 20.0, iterations=100)
    assert {row["iterations"] for row in point_rows([*records, more])} == {100}


def test_leads_in_equal_time() -> None:
    rows = equal_time_rows(length_rows(length_records()), "gaussian")
    assert [(row["system"], row["reference_iterations"], row["seconds"]) for row in rows] == [
        ("default", 100, 1.0),
        ("default", 200, 2.0),
        ("default", 400, 4.0),
    ]
    assert rows[0]["lead"] is None, "its shortest run takes twice as long"
    assert [row["lead"] for row in rows[1:]] == [pytest.approx(0.5)] * 2
    head, lines = equal_time_table(rows, "gaussian")
    assert head == ("scene", "system", *(f"gaussian, {n} iterations" for n in (100, 200, 400)))
    assert lines == [("yard 8x6", "default", "", "+0.50", "+0.50")]
    assert equal_time_rows(length_rows(length_records()), "3dgs") == []
    assert equal_time_table([], "3dgs") == ((), [])


def test_splats_needed_is_linear_in_log_splats() -> None:
    line = [(4000, 22.0), (1000, 20.0), (2000, 21.0)]
    assert splats_needed(line, 20.5) == pytest.approx(1000 * 2**0.5)
    assert splats_needed(line, 21.0) == pytest.approx(2000)
    assert splats_needed(line, 19.0) == 1000, "a bound: the smallest is better already"
    assert splats_needed(line, 22.1) is None
    dip = [(1000, 20.0), (2000, 22.0), (4000, 21.0), (8000, 24.0)]
    assert splats_needed(dip, 21.5) == pytest.approx(1000 * 2**0.75), "where it first is good enough"


def test_points_and_fronts() -> None:
    points = point_rows(sweep_records())
    assert [(p["system"], p["cap"], p["front_splats"]) for p in points] == [
        ("gaussian", 1000, False),
        ("default", 1000, True),
        ("half-gaussian", 1500, True),
        ("gaussian", 2000, False),
        ("default", 2000, False),
        ("gaussian", 4000, False),
        ("default", 4000, True),
    ]
    assert points[0]["render_ms"] == 10
    assert points[0]["shape"] == "gaussian"


def test_points_are_means_of_runs_that_did_not_fail() -> None:
    runs = [run_record("a", cap, 20.0 + seed, seed) for cap in (10, 20) for seed in (0, 1)]
    runs += [run_record("a", 10, 30.0, 0, repeat=1), run_record("b", 10, failed="lost")]
    points = point_rows(runs)
    assert [(p["system"], p["seeds"], p["psnr"]) for p in points] == [("a", 2, 20.5), ("a", 2, 20.5)]


def test_a_scene_of_one_cap_is_no_sweep_and_other_lengths_are_left_out() -> None:
    assert point_rows(seed_records()) == []
    longer = run_record("gaussian", 4000, 30.0, iterations=900)
    assert max(p["psnr"] for p in point_rows([*sweep_records(), longer])) == 22.5


def test_equal_quality() -> None:
    rows = equal_rows(point_rows(sweep_records()), "gaussian")
    assert [(row["system"], row["reference_cap"], row["bound"]) for row in rows] == [
        ("default", 1000, "at most"),
        ("default", 2000, ""),
        ("default", 4000, ""),
    ]
    assert [row["ratio"] for row in rows] == pytest.approx([1.0, 2**-0.5, 2**-0.5])
    head, lines = equal_table(rows, "gaussian")
    assert head == ("scene", "system", "gaussian, cap 1000", "gaussian, cap 2000", "gaussian, cap 4000")
    assert lines == [("yard 8x6", "default", "≤ 100 %", "71 %", "71 %")]
    other = equal_rows(point_rows(sweep_records()), "default")
    assert [row["splats"] for row in other][-1] is None
    assert equal_table(other, "default")[1][0][-1] == "not reached"
    assert equal_rows(point_rows(sweep_records()), "none") == []


def test_curves_are_of_the_cap_that_most_were_followed_at() -> None:
    runs = [
        run_record("a", 10, curve=curve_points(20)),
        run_record("b", 10, curve=curve_points(21)),
        run_record("b", 99, curve=curve_points(22)),
        run_record("c", 99),
        run_record("a", 10, curve=curve_points(20), repeat=1),
        run_record("d", 10, failed="x", curve=[]),
    ]
    rows = curve_rows(runs)
    assert {(row["system"], row["cap"]) for row in rows} == {("a", 10), ("b", 10)}
    assert [row["iteration"] for row in rows] == [1, 4, 20, 100] * 2
    assert rows[0]["seconds"] == 0.1


def test_seeds_and_repeats() -> None:
    rows = seed_rows([*seed_records(), *sweep_records()])
    assert len(rows) == 14
    _, lines = seed_table(rows)
    assert lines[0] == ("attic 8x6", "500", "gaussian", "5", "20.20", "20.00", "20.40", "0.40", "3", "0.0000", "yes")
    rows[-1]["digest"] = "another"
    assert seed_table(rows)[1][1][-1] == "no"
    assert seed_rows(seed_records()[:2]) == []


def test_rows_are_written_as_csv_and_json(tmp_path: Path) -> None:
    rows = point_rows(sweep_records())
    paths = write_rows(tmp_path / "deep", "size", rows)
    assert [path.name for path in paths] == ["size.csv", "size.json"]
    assert json.loads(paths[1].read_text()) == rows
    with paths[0].open(newline="") as stream:
        read = list(csv.DictReader(stream))
    assert [float(row["psnr"]) for row in read] == [row["psnr"] for row in rows]


# --- the page ----------------------------------------------------------------------------------


def test_a_page_needs_nothing_beside_it(tmp_path: Path) -> None:
    svg = tmp_path / "a.svg"
    svg.write_text(
        '<?xml version="1.0"?>\n<!DOCTYPE svg>\n<svg width="9"><metadata>x</metadata><path id="m1"/>'
        '<use xlink:href="#m1" clip-path="url(#p)"/></svg>'
    )
    path = write_page(
        tmp_path / "r.html",
        "a & b",
        [Section("one", ["<b>"], svg, ("name", "n"), [("x", "1"), ("y", "2")], ["a.csv"]), Section("two", chart=svg)],
    )
    text = path.read_text()
    assert "<title>a &amp; b</title>" in text
    assert "&lt;b&gt;" in text
    assert '<svg role="img" aria-label="one" width="9">' in text
    assert text.count('id="c1-m1"') == text.count('href="#c1-m1"') == text.count("url(#c1-p)") == 1
    assert text.count('id="c2-m1"') == 1, "charts of one page have ids of their own"
    assert "metadata" not in text
    assert text.count("<?xml") == text.count("<script") == text.count("http") == 0
    assert "<th class=text>name</th><th>n</th>" in text
    assert '<a href="a.csv">' in text
    with pytest.raises(InputError, match="draw the chart again"):
        write_page(path, "t", [Section("one", chart=tmp_path / "none.svg")])


def test_report_without_matplotlib(tmp_path: Path, undrawn: None) -> None:
    paths = write_report(tmp_path, [*sweep_records(), *seed_records()], reference="gaussian")
    assert {path.name for path in paths} == {
        f"{name}.{kind}" for name in ("size", "equal", "time", "seeds") for kind in ("csv", "json")
    } | {"report.html"}
    text = (tmp_path / "report.html").read_text()
    assert text.count("pip install") == 4
    assert "<svg" not in text
    assert "71 %" in text
    with pytest.raises(InputError, match="no runs to draw"):
        write_report(tmp_path, [])


def test_means_over_different_seeds_have_a_note(tmp_path: Path, undrawn: None) -> None:
    """The note is below the table, and in the sections of the charts whose points have other seeds."""
    said = "different seeds on yard 8x6: means are over (0) or (0, 1), so their differences are partly chance"
    plain, more = sweep_records(), run_record("gaussian", 2000, 30.0, 1)
    records = [*plain, more]
    assert said in notes(records, summarise(records))
    assert said not in notes(plain, summarise(plain))
    failed = run_record("gaussian", 2000, seed=1, failed="lost") | {"psnr": None, "ssim": None}
    assert said not in notes([*plain, failed], summarise([*plain, failed])), "a mean of one seed"
    other = [record | {"config": record["config"] | {"seed": 1}} for record in plain[:1]]
    apart = notes([*other, *plain[1:]], summarise([*other, *plain[1:]]))
    assert any("means are over (0) or (1)," in line for line in apart), "as many, but others"
    sentence = f"D{said[1:]}."
    write_report(tmp_path, records, reference="gaussian")
    assert (tmp_path / "report.html").read_text().count(sentence) == 3, "protocol, size and equal quality"
    lengths = length_records()
    write_report(tmp_path, [*lengths, run_record("gaussian", 1000, 30.0, 1, iterations=100)], reference="gaussian")
    text = (tmp_path / "report.html").read_text()
    assert text.count(sentence) == 1, "the chart of lengths leaves out a seed of one length, the table does not"


def test_a_reference_that_nothing_reaches_has_a_page(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    best = [record | {"psnr": record["psnr"] + 50.0 * (record["system"] == "gaussian")} for record in sweep_records()]
    paths = write_report(tmp_path, best, reference="gaussian")
    assert "No chart: no other system reaches the PSNR of gaussian." in (tmp_path / "report.html").read_text()
    assert {path.stem for path in paths} >= {"size", "equal", "report"}
    assert not (tmp_path / "charts" / "equal.svg").exists()


def test_equal_runs_of_two_folders_count_once(tmp_path: Path, undrawn: None) -> None:
    again = [record | {"psnr": 1.0} for record in sweep_records()]
    write_report(tmp_path, [*sweep_records(), *again])
    rows = json.loads((tmp_path / "charts" / "size.json").read_text())
    assert [row["seeds"] for row in rows] == [1] * 7
    assert min(row["psnr"] for row in rows) == 20.0


# --- the sweep ---------------------------------------------------------------------------------


def test_an_interrupted_sweep_leaves_charts_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undrawn: None, capture_folder: Path
) -> None:
    made = []

    def train_and_measure(_: Any, config: Any, *more: Any) -> Record:
        made.append(config.cap_max)
        if len(made) == 4:
            raise KeyboardInterrupt
        psnr = 20 + config.cap_max / 100
        values = run_record("", config.cap_max, psnr, curve=curve_points(psnr))
        return {key: value for key, value in values.items() if key not in ("scene", "system", "config", "repeat")}

    monkeypatch.setattr(compare_module, "warm_up", lambda *arguments: None)
    monkeypatch.setattr(compare_module, "train_and_measure", train_and_measure)
    scene, systems = load_scene(capture_folder), parse_methods("gaussian,default")
    arguments = ([scene], systems, tmp_path, [20, 40], [0], {"iterations": 9})
    with pytest.warns(UserWarning, match=r"clsplat\[charts\]"), pytest.raises(KeyboardInterrupt):
        sweep(*arguments)
    shown = json.loads((tmp_path / "charts" / "size.json").read_text())
    assert [(row["system"], row["cap"]) for row in shown] == [("gaussian", 20), ("default", 20), ("gaussian", 40)]
    assert (tmp_path / "report.html").exists()
    with pytest.warns(UserWarning, match=r"clsplat\[charts\]"):
        records = sweep(*arguments, more=[run_record("gaussian", 30, 25.0)])
    assert made == [20, 20, 40, 40, 40]
    assert len(records) == 4
    shown = json.loads((tmp_path / "charts" / "size.json").read_text())
    assert len(shown) == 4, "another scene's run is not of this front"


def test_a_disk_that_is_full_from_the_start_is_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undrawn: None, capture_folder: Path
) -> None:
    """runs.jsonl is made and stays empty. That there are no runs to draw is not what went wrong."""

    def full(self: RunFile, record: Record) -> None:
        self.path.touch()
        raise OutputError(f"{self.path}: cannot be written (No space left on device): free some space")

    monkeypatch.setattr(compare_module, "warm_up", lambda *arguments: None)
    monkeypatch.setattr(compare_module, "train_and_measure", lambda *arguments: {})
    monkeypatch.setattr(RunFile, "add", full)
    with pytest.warns(UserWarning, match=r"clsplat\[charts\]"), pytest.raises(OutputError, match="No space left"):
        sweep([load_scene(capture_folder)], parse_methods("gaussian"), tmp_path, [20], [0], {"iterations": 9})
    assert not (tmp_path / "report.html").exists()


def test_runs_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"runs.jsonl: cannot be read .*give the folder of a comparison"):
        read_runs(tmp_path)
    (tmp_path / "runs.jsonl").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="cannot be read"):
        read_runs(tmp_path / "runs.jsonl")
