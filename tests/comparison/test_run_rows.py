"""Lines of runs.jsonl: a damaged one is named with its line and value, and none vanishes without a word."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
from cli_runner import error_of, run
from sweep_records import curve_points, run_record, seed_records, sweep_records

from clsplat.comparison import compare as module
from clsplat.comparison.compare import compare
from clsplat.comparison.length_rows import length_rows
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.run_rows import parse_runs
from clsplat.comparison.runs import RunFile, read_runs
from clsplat.comparison.sweep_rows import curve_rows, point_rows, seed_rows
from clsplat.errors import InputError
from clsplat.evaluation import chart_style
from clsplat.scenes.scene import Scene

FILE = Path("out/runs.jsonl")


def changed(**values: Any) -> str:
    """The line of a run with other values, by key or by "part__key"."""
    record = run_record("gaussian", curve=curve_points(20.0))
    for name, value in values.items():
        *parts, key = name.split("__")
        place = record
        for part in parts:
            place = place[part]
        place[key] = value
    return json.dumps(record)


def without(part: str, key: str) -> str:
    """The line of a run without a value."""
    record = run_record("gaussian")
    del record[part][key]
    return json.dumps(record)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (changed(psnr="abc"), "psnr is the text 'abc'; expected a number or null"),
        (changed(psnr=float("nan")), "psnr is nan; expected a number or null"),
        (changed(psnr=float("-inf")), "psnr is -inf; expected a number or null"),
        (changed(psnr=None), "psnr is null; expected a number"),
        (changed(seconds=None), "seconds is null; expected a number"),
        (changed(config=5), "config is 5; expected an object"),
        (changed(config__cap_max="x"), "config.cap_max is the text 'x'; expected a whole number"),
        (changed(config__seed=1.5), "config.seed is 1.5; expected a whole number"),
        (changed(config__shape=None), "config.shape is null; expected a text"),
        (without("config", "cap_max"), "config.cap_max is null; expected a whole number"),
        (changed(scene="fox"), "scene is the text 'fox'; expected an object"),
        (changed(scene={}), "scene.name is null; expected a text"),
        (changed(scene__width=-1), "scene.width is -1; expected a whole number"),
        (changed(system=7), "system is 7; expected a text"),
        (changed(protocol="x"), "protocol is the text 'x'; expected an object"),
        (without("protocol", "PSNR"), "protocol.PSNR is null; expected a text"),
        (changed(curve=7), "curve is 7; expected a list of objects or null"),
        (changed(curve=[{"iteration": 1}]), "curve.seconds is null; expected a number"),
        (changed(failed=3), "failed is 3; expected a text or null"),
        (changed(device={}), "device is an object; expected a text"),
        (changed(finite=1), "finite is 1; expected true or false"),
        (changed(repeat=True), "repeat is true; expected a whole number"),
    ],
)
def test_a_value_that_no_run_has_written_is_named_with_its_line(line: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_runs("\n".join([changed(), "", line, changed()]), FILE)
    assert str(caught.value) == f"{FILE}: line 3: {said}: remove the line, so that its run is repeated"


def test_what_runs_write_is_read() -> None:
    failed = run_record("a", failed="lost") | {"psnr": None, "ssim": None, "seconds": None, "splats": None}
    records = [*sweep_records(), *seed_records(), failed, run_record("b") | {"render_ms": None}]
    old = {key: value for key, value in records[0].items() if key not in ("repeat", "digest", "curve")}
    lines = [json.dumps(record) for record in (*records, old)]
    assert parse_runs("\n".join(lines), FILE) == list(map(json.loads, lines))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (changed()[:40], "is no JSON object"),
        ("[" * 100_000, "is no JSON object"),
        ("7", "is no JSON object"),
        ("{}", "has no bytes"),
    ],
)
def test_a_line_that_cannot_be_read_is_left_out_with_a_warning(line: str, said: str) -> None:
    text = "\n".join([changed(), line, changed(), ""])
    with pytest.warns(UserWarning, match=f"runs.jsonl: line 2 {said} and is left out: remove it") as told:
        assert parse_runs(text, FILE) == [json.loads(changed())] * 2
    assert len(told) == 1
    with pytest.warns(UserWarning, match="line 2"):
        parse_runs(f"{changed()}\n{line}\n", FILE)


def test_a_last_line_that_a_crash_cut_short_is_left_out_silently() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert parse_runs(f"{changed()}\n{changed()[:40]}", FILE) == [json.loads(changed())]
        assert len(parse_runs(f"{changed()}\n{changed()}", FILE)) == 2, "a whole line without its end"
        assert parse_runs("", FILE) == []


@pytest.mark.parametrize("cut", [40, None])
def test_the_next_run_has_a_line_of_its_own(tmp_path: Path, cut: int | None) -> None:
    """What is left of a line is removed, so that it gives no warning later. A whole line without its end stays."""
    path = tmp_path / "runs.jsonl"
    path.write_text(f"{changed()}\n{changed(config__seed=1)[:cut]}")
    RunFile(tmp_path).add(json.loads(changed(config__seed=2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        records = read_runs(path)
    assert [record["config"]["seed"] for record in records] == ([0, 2] if cut else [0, 1, 2])


def test_damage_is_found_before_the_first_run(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "runs.jsonl"
    path.write_text(changed(psnr="x") + "\n")
    monkeypatch.setattr(module, "train_and_measure", lambda *arguments: pytest.fail("a run was trained"))
    with pytest.raises(InputError, match=r"runs.jsonl: line 1: psnr is the text 'x'"):
        compare([scene], parse_methods("gaussian"), tmp_path, [60], [0], {"iterations": 9})
    assert path.read_text() == changed(psnr="x") + "\n"


def test_the_commands_print_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capture_folder: Path) -> None:
    monkeypatch.setattr(chart_style, "available", lambda: False)
    path = tmp_path / "runs.jsonl"
    path.write_text(changed(psnr="x") + "\n")
    said = f"{path}: line 1: psnr is the text 'x'"
    assert said in error_of("frontier", "-o", tmp_path, "--charts-only")
    assert said in error_of("compare", capture_folder, "-o", tmp_path, "--systems", "gaussian", "--iterations", "8")
    assert said in error_of("frontier", capture_folder, "-o", tmp_path, "--systems", "gaussian", "--iterations", "8")
    path.write_text(f"{changed()}\n7\n")
    for arguments in (("--charts-only",), (capture_folder, "--iterations", "8", "--cap-max", "30", "--curve", "0")):
        done = run("frontier", "-o", tmp_path, "--systems", "gaussian", "-q", *arguments)
        assert done.exit_code == 0, done.output
        assert done.stderr.count("warning: ") - done.stderr.count("warning: charts need") == 1
        assert f"warning: {path}: line 2 is no JSON object and is left out" in done.stderr


def test_a_run_of_equal_images_has_no_place_in_a_chart() -> None:
    """Its PSNR is infinite."""
    equal = [record | {"psnr": float("inf")} for record in (*sweep_records("shed"), *seed_records())]
    for record in equal:
        if record["curve"]:
            record["curve"] = [point | {"psnr": float("inf")} for point in record["curve"]]
    assert len(parse_runs("\n".join(map(json.dumps, equal)), FILE)) == len(equal)
    assert [] == point_rows(equal) == length_rows(equal) == curve_rows(equal) == seed_rows(equal)
