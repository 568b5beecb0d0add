"""Comparisons that workers do: the rows of one without them, whatever dies in between."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Collection, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from clsplat.cluster import training as module
from clsplat.cluster.job import Abandoned, Job, MissingFiles
from clsplat.cluster.pool import WorkerPool
from clsplat.cluster.training import MARK, in_folder, marked, scene_of, unmark
from clsplat.comparison import compare as compare_module
from clsplat.comparison import planned
from clsplat.comparison.compare import compare
from clsplat.comparison.jobs import UNFINISHED
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.runs import Run
from clsplat.comparison.table import Record
from clsplat.errors import ClsplatError, OutputError
from clsplat.files.lock import folder_lock
from clsplat.scenes.scene import Scene, load_scene

pytest.importorskip("distributed")
CAP = 60
SHORT: dict[str, Any] = {"iterations": 20, "sh_degree": 1, "densify_interval": 5}
WORKERS = f"local:{min(len(os.sched_getaffinity(0)), 2)}"
TIMES = {"seconds", "cpu_seconds", "render_ms", "peak_bytes", "device_bytes", "curve"}  # of a run: never twice the same


def lines(folder: Path) -> list[Record]:
    """Return the lines of runs.jsonl, without times and memory."""
    rows = [json.loads(line) for line in (folder / "runs.jsonl").read_text().splitlines()]
    return [{key: value for key, value in row.items() if key not in TIMES} for row in rows]


def test_workers_write_the_files_of_a_comparison_without_them(scene: Scene, tmp_path: Path) -> None:
    """The same bits (digest), in the same order."""
    seen: list[tuple[str, int, bool]] = []

    def on_run(run: Run, record: Record | None) -> None:
        seen.append((run.system, run.config.seed, record is not None))

    systems = parse_methods("gaussian,default")
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    compare([scene], systems, alone, [CAP], [0, 1], SHORT, save_models=True, curve=3)
    compare([scene], systems, shared, [CAP], [0, 1], SHORT, save_models=True, curve=3, cluster=WORKERS, on_run=on_run)
    assert lines(shared) == lines(alone)
    assert {path.relative_to(shared) for path in shared.rglob("*")} == {
        path.relative_to(alone) for path in alone.rglob("*")
    }
    for model in (alone / "models").iterdir():
        assert (shared / "models" / model.name).read_bytes() == model.read_bytes()
    for row, other in zip(*[_curves(folder) for folder in (alone, shared)], strict=True):
        assert row == other
    assert sorted(seen) == sorted((s.label, seed, done) for s in systems for seed in (0, 1) for done in (False, True))
    again: list[Run] = []
    compare([scene], systems, shared, [CAP], [0, 1], SHORT, cluster=WORKERS, on_run=lambda run, _: again.append(run))
    assert again == []


def _curves(folder: Path) -> list[list[tuple[float, ...]]]:
    """Return the points of the curves of all runs, without their times."""
    rows = [json.loads(line) for line in (folder / "runs.jsonl").read_text().splitlines()]
    return [[(point["iteration"], point["psnr"], point["ssim"]) for point in row["curve"]] for row in rows]


class CountedWork:
    """A `JobContext` in this process that is wanted for some iterations, and counts those that it has seen."""

    device = None

    def __init__(self, wanted: int) -> None:
        self.wanted, self.seen = wanted, 0

    def report(self, share: float) -> None:
        assert 0 <= share <= 1

    def stop_if_unwanted(self, trainer: object, stop: threading.Event) -> None:
        self.seen += 1
        if self.seen == self.wanted:
            stop.set()


class PoolHere(WorkerPool):
    """Does the jobs in this process, the last one first.

    Parameters
    ----------
    works : what each job gets from its worker. fails : numbers of jobs that fail.
    """

    def __init__(self, works: Iterator[CountedWork], fails: Collection[int] = ()) -> None:
        self.works, self.fails = works, fails

    def __enter__(self) -> PoolHere:
        return self

    def __exit__(self, *_: object) -> None: ...

    def results(self, jobs: Sequence[Job], on_begin: object = None) -> Iterator[tuple[int, Any]]:
        for number in reversed(range(len(jobs))):
            if number in self.fails:
                yield number, OutputError("disk full")
            else:
                yield number, jobs[number].function(next(self.works), *jobs[number].arguments)


@pytest.mark.parametrize("curve", [0, 3])
def test_a_run_that_was_cut_short_goes_on(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, curve: int
) -> None:
    """No iteration is done twice, and the record is that of a run in one piece."""
    systems, out = parse_methods("gaussian"), tmp_path / "out"
    compare([scene], systems, tmp_path / "whole", [CAP], [0], SHORT, curve=curve)
    works = [CountedWork(8), CountedWork(1000)]
    left = iter(works)

    monkeypatch.setattr(planned, "WorkerPool", lambda *_: PoolHere(left))
    with pytest.raises(Abandoned):
        compare([scene], systems, out, [CAP], [0], SHORT, curve=curve, cluster="local")
    assert [path.is_dir() for path in (out / UNFINISHED).iterdir()] == [True]
    compare([scene], systems, out, [CAP], [0], SHORT, curve=curve, cluster="local")
    assert [work.seen for work in works] == [8, SHORT["iterations"] - 8]
    assert lines(out) == lines(tmp_path / "whole")
    if curve:
        assert _curves(out) == _curves(tmp_path / "whole")
    assert {path.name for path in out.iterdir()} == {"runs.jsonl", "table.md", "results.json"}


def test_runs_end_in_any_order_and_one_may_fail(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines are in the order of the plan. A failed run ends no other, and the next call does it."""
    systems, out = parse_methods("gaussian,default"), tmp_path / "out"
    compare([scene], systems, tmp_path / "whole", [CAP], [0, 1], SHORT)
    fails = [1]

    works = (CountedWork(1000) for _ in count())
    monkeypatch.setattr(planned, "WorkerPool", lambda *_: PoolHere(works, fails))
    with pytest.raises(OutputError, match="disk full"):
        compare([scene], systems, out, [CAP], [0, 1], SHORT, cluster="local")
    assert lines(out) == [line for place, line in enumerate(lines(tmp_path / "whole")) if place != 1]
    fails.clear()
    compare([scene], systems, out, [CAP], [0, 1], SHORT, cluster="local")
    assert sorted(map(str, lines(out))) == sorted(map(str, lines(tmp_path / "whole")))


def test_a_scene_that_workers_do_not_have(
    capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its runs fail with one line, after all others; the next call does them."""
    scenes = []
    for name in ("here", "gone"):
        shutil.copytree(capture_folder, tmp_path / name)
        scenes.append(load_scene(tmp_path / name))
    out = tmp_path / "out"
    (tmp_path / "gone").rename(tmp_path / "elsewhere")
    plan = compare_module._missing

    def with_photos(*arguments: Any) -> Any:
        """Let the program itself have the scene, but no worker."""
        (tmp_path / "elsewhere").rename(tmp_path / "gone")
        yield from list(plan(*arguments))
        (tmp_path / "gone").rename(tmp_path / "elsewhere")

    monkeypatch.setattr(compare_module, "_missing", with_photos)
    with pytest.raises(ClsplatError, match=r"worker .*gone"):
        compare(scenes, parse_methods("gaussian"), out, [CAP], [0], SHORT, cluster="local:1")
    assert [row["scene"]["name"] for row in lines(out)] == ["here"]
    (tmp_path / "elsewhere").rename(tmp_path / "gone")
    monkeypatch.undo()
    compare(scenes, parse_methods("gaussian"), out, [CAP], [0], SHORT, cluster="local:1")
    assert [row["scene"]["name"] for row in lines(out)] == ["here", "gone"]


def test_a_run_uses_its_folder_only_where_it_is_the_same_one(tmp_path: Path) -> None:
    place = marked(tmp_path / UNFINISHED)
    assert (place / MARK).is_file()
    assert in_folder(place / "run", lambda folder: folder) == place / "run"
    with folder_lock(place / "run"):
        pass
    unseen = tmp_path / "unseen" / "run"
    assert in_folder(unseen, lambda folder: folder.is_dir() and folder != unseen)
    with pytest.raises(MissingFiles, match="this machine does not see that folder"):
        in_folder(unseen, lambda folder: folder, keep=True)
    unmark(place)
    assert (place / "run").is_dir(), "an unfinished run stays"
    (place / "run").rmdir()
    unmark(marked(place))
    assert not place.exists()


def test_a_folder_in_use_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that the scheduler has lost may go on in it."""

    def held(folder: Path) -> Any:
        raise OutputError(f"{folder}: another run writes into it")

    place = marked(tmp_path / UNFINISHED)
    monkeypatch.setattr(module, "folder_lock", held)
    assert in_folder(place / "run", lambda folder: folder) != place / "run"
    with pytest.raises(OutputError, match="another run"):
        in_folder(place / "run", lambda folder: folder, keep=True)


def test_a_folder_that_cannot_be_written_is_replaced(tmp_path: Path) -> None:
    """A worker on another machine may have another user. Root can write everywhere, so a file is in the way here."""
    place = marked(tmp_path / UNFINISHED)
    (place / "run").touch()
    assert in_folder(place / "run", lambda folder: folder.is_dir() and folder != place / "run")
    with pytest.raises(OutputError, match=r"run: cannot be written \(File exists\): let the user of this worker"):
        in_folder(place / "run", lambda folder: folder, keep=True)


def test_a_folder_for_runs_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    """Root can write everywhere, so a file is in the way: in place of the folder, and above it."""
    (tmp_path / UNFINISHED).touch()
    for place, why in ((tmp_path / UNFINISHED, "File exists"), (tmp_path / UNFINISHED / "runs", "Not a directory")):
        with pytest.raises(OutputError) as caught:
            marked(place)
        assert str(caught.value) == f"{place}: cannot be written ({why}); check rights and space"
    place = tmp_path / "other"
    (place / MARK / "in the way").mkdir(parents=True)
    marked(place)
    unmark(place)
    assert (place / MARK).is_dir(), "a folder that is not empty stays"


def test_scenes_are_read_once_in_a_row() -> None:
    read: list[str] = []

    def load(source: str) -> Any:
        read.append(source)
        return source

    assert [scene_of(source, load) for source in ("a", "a", "b", "a")] == ["a", "a", "b", "a"]
    assert read == ["a", "b", "a"]
