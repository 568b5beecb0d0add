"""Scenes of runs: other photos, masks, cameras or test views are other runs, with titles that differ."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sweep_records import run_record, sweep_records

from clsplat.cameras.camera import Camera
from clsplat.comparison import compare as module
from clsplat.comparison.compare import compare
from clsplat.comparison.length_rows import length_rows
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.runs import RunFile, distinct, read_runs
from clsplat.comparison.scene_identity import scene_identity, scene_title, titled, with_contents
from clsplat.comparison.sweep_rows import curve_rows, equal_rows, point_rows, seed_rows
from clsplat.comparison.table import Record, summarise
from clsplat.scenes.scene import Scene
from clsplat.scenes.view import View
from clsplat.training.config import TrainConfig

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
SHORT: dict[str, Any] = {"iterations": 20, "sh_degree": 1, "densify_interval": 5}


def other_test_views(scene: Scene) -> Scene:
    """The scene with as many other test views."""
    return replace(scene, test_names=frozenset(view.name for view in scene.train[: len(scene.test)]))


def other_masks(scene: Scene) -> Scene:
    """The scene with another digest of one photo and its mask."""
    return replace(scene, photo_digests=dict(scene.photo_digests) | {scene.names[0]: "0" * 16})


def other_pixels(scene: Scene) -> Scene:
    """The scene with a dark photo that no file holds."""
    view = scene.views[0].loaded()
    dark = View(view.name, view.camera, view.image // 2)
    digests = {name: value for name, value in scene.photo_digests.items() if name != view.name}
    return replace(scene, views=[dark, *scene.views[1:]], photo_digests=digests)


def other_camera(scene: Scene) -> Scene:
    """The scene with another focal length of one camera."""
    view = scene.views[0].loaded()
    c = view.camera
    camera = Camera(c.width, c.height, c.fx * 1.01, c.fy, c.cx, c.cy, c.cam_from_world)
    return replace(scene, views=[replace(view, camera=camera), *scene.views[1:]])


def other_points(scene: Scene) -> Scene:
    """The scene with its points elsewhere."""
    return replace(scene, points=replace(scene.points, xyz=scene.points.xyz + 1.0))


CHANGES = (other_test_views, other_masks, other_pixels, other_camera, other_points)


@pytest.mark.parametrize("change", CHANGES)
def test_another_scene_of_equal_numbers_is_another_one(scene: Scene, change: Callable[[Scene], Scene]) -> None:
    before, after = scene_identity(scene), scene_identity(change(scene))
    assert before.pop("content") != after.pop("content")
    assert before == after, "the numbers are equal"


def test_the_last_bits_of_a_camera_do_not_count(scene: Scene) -> None:
    """Another machine may round a pose in another way."""
    view = scene.views[0].loaded()
    c = view.camera
    camera = Camera(c.width, c.height, float(np.nextafter(c.fx, 9e9)), c.fy, c.cx, c.cy, c.cam_from_world)
    near = replace(scene, views=[replace(view, camera=camera), *scene.views[1:]])
    assert scene_identity(near) == scene_identity(scene)


def test_other_test_views_are_measured(scene: Scene, tmp_path: Path) -> None:
    systems = parse_methods("gaussian")
    compare([scene], systems, tmp_path, [60], [0], SHORT)
    records = compare([other_test_views(scene)], systems, tmp_path, [60], [0], SHORT)
    assert len({record["psnr"] for record in records}) == 2
    rows = summarise(records)
    assert len({row["scene"] for row in rows}) == 2
    assert all(row["scene"].startswith("yard 48x36, content ") for row in rows)
    assert compare([scene], systems, tmp_path, [60], [0], SHORT) == records, "both are finished"


# --- rows of older versions --------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Collect the seeds of the runs that are trained. A stub replaces the training."""
    trained = []

    def train_and_measure(scene: Scene, config: TrainConfig, *more: object) -> Record:
        trained.append(config.seed)
        values = run_record("", psnr=20.0 + len(trained))
        return {key: value for key, value in values.items() if key not in ("scene", "system", "config", "repeat")}

    monkeypatch.setattr(module, "warm_up", lambda *arguments: None)
    monkeypatch.setattr(module, "train_and_measure", train_and_measure)
    return trained


def without_digests(folder: Path) -> None:
    """Write runs.jsonl as older versions did."""
    path = folder / "runs.jsonl"
    records = [json.loads(line) for line in path.read_text().splitlines()]
    for record in records:
        del record["scene"]["content"]
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


def test_rows_without_a_digest_are_runs_on_the_first_scene_that_fits(
    scene: Scene, counted: list[int], tmp_path: Path
) -> None:
    systems = parse_methods("gaussian")
    compare([scene], systems, tmp_path, [60], [0], SHORT)
    without_digests(tmp_path)
    with pytest.warns(UserWarning, match=r"runs.jsonl: an older version wrote runs on yard without a digest") as told:
        records = compare([scene], systems, tmp_path, [60], [0, 1], SHORT)
    assert len(told) == 1
    assert counted == [0, 1], "the old row is recognised"
    assert [row["seeds"] for row in summarise(records)] == [[0, 1]], "old and new rows make one row"
    # Other test views are another scene, once a row has a digest.
    records = compare([other_test_views(scene)], systems, tmp_path, [60], [0], SHORT)
    assert counted == [0, 1, 0]
    assert [row["seeds"] for row in summarise(records)] == [[0, 1], [0]]


def test_a_repeated_run_replaces_its_row_without_a_digest(scene: Scene, counted: list[int], tmp_path: Path) -> None:
    systems = parse_methods("gaussian")
    compare([scene], systems, tmp_path, [60], [0], SHORT)
    without_digests(tmp_path)
    records = compare([scene], systems, tmp_path, [60], [0], SHORT, curve=3)
    assert len(counted) == 2, "a run without a curve is repeated"
    assert [record["scene"] for record in records] == [scene_identity(scene)]


def test_equal_runs_of_an_old_and_a_new_folder_count_once() -> None:
    old = run_record("gaussian")
    new = old | {"scene": old["scene"] | {"content": "a" * 16}}
    other = old | {"scene": old["scene"] | {"content": "b" * 16}}
    assert distinct([old, new, other]) == [old, other]
    assert with_contents([old]) == [old]
    assert [record["scene"]["content"][0] for record in with_contents([old, new, other])] == ["a", "a", "b"]


def test_the_stored_runs_of_the_benchmarks_are_read_and_drawn() -> None:
    """They are of versions without a digest. Each of them is found as the run of a scene with its numbers."""
    found = {path: read_runs(path) for path in RESULTS.rglob("runs.jsonl")}
    assert len(found) >= 6
    for path, records in found.items():
        assert len(records) == len(path.read_text().splitlines()) == len(distinct(records))
        runs = RunFile(path.parent)
        for record in (records[0], records[-1]):
            scene = record["scene"] | {"content": "a" * 16}
            same = runs._place({**record, "scene": scene})
            assert same is not None
            assert runs.records[same] == record
    drawn = found[RESULTS / "frontier" / "runs.jsonl"]
    titles = {row["scene"] for row in point_rows(drawn)}
    assert titles >= {"fox 200x356", "kitchen 400x267", "lego_full 800x800"}
    assert {row["scene"] for row in length_rows(drawn)} >= {"fox 200x356"}
    assert not any("," in row["scene"] for row in summarise(drawn)), "no two of these scenes share their name and size"


# --- titles ------------------------------------------------------------------------------------


def of_split(records: list[Record], psnr: float, **changes: object) -> list[Record]:
    """The records with another scene, and a PSNR that is higher by `psnr`."""
    return [
        record | {"scene": record["scene"] | changes, "psnr": record["psnr"] + psnr, "digest": f"{changes}"}
        for record in records
    ]


def test_two_splits_are_two_scenes_in_every_chart() -> None:
    plain = sweep_records()
    split = of_split(plain, 3.0, test=2, train=2)
    both = [*plain, *split]
    points = point_rows(both)
    assert {row["scene"] for row in points} == {"yard 8x6, 1 test view", "yard 8x6, 2 test views"}
    assert len(points) == 2 * len(point_rows(plain))
    for name in ("yard 8x6, 1 test view", "yard 8x6, 2 test views"):
        ratios = [row["ratio"] for row in equal_rows(points, "gaussian") if row["scene"] == name]
        assert ratios == [row["ratio"] for row in equal_rows(point_rows(plain), "gaussian")]
    assert len({row["scene"] for row in curve_rows(both)}) == 2
    assert len({row["scene"] for row in summarise(both)}) == 2
    seeds = [run_record("gaussian", seed=seed) for seed in range(3)]
    assert len({row["scene"] for row in seed_rows([*seeds, *of_split(seeds, 1.0, test=2)])}) == 2
    lengths = [run_record("gaussian", iterations=n, seconds=n / 10) for n in (10, 20)]
    assert len({row["scene"] for row in length_rows([*lengths, *of_split(lengths, 1.0, test=2)])}) == 2


def test_a_title_has_what_distinguishes_scenes_and_no_more() -> None:
    def titles(*changes: dict[str, object]) -> list[str]:
        record = run_record("a")
        return [scene_title(each) for each in titled([record | {"scene": record["scene"] | more} for more in changes])]

    a, b, near = "a" * 16, "b" * 16, "a" * 15 + "c"
    assert titles({"content": a}) == ["yard 8x6"]
    assert titles({"content": a}, {"content": a}) == ["yard 8x6"] * 2
    assert titles({}, {"content": a}) == ["yard 8x6"] * 2, "a row of an older version"
    assert titles({"width": 9}, {}) == ["yard 9x6", "yard 8x6"]
    assert titles({"train": 4}, {}) == ["yard 8x6, 4 training views", "yard 8x6, 3 training views"]
    assert titles({"content": a}, {"content": b}) == ["yard 8x6, content aaaa", "yard 8x6, content bbbb"]
    assert len(set(titles({"content": a}, {"content": near}))) == 2
    three = titles({"content": a}, {"content": b}, {"test": 2})
    assert three[0] == "yard 8x6, 1 test view, content aaaa"
    assert len(set(three)) == 3
    assert titles({"set": "s", "images": "i"}, {"set": "s", "images": "j"}) == ["yard 8x6"] * 2
