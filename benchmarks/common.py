"""What the benchmarks share: command lines, real scenes, files of finished runs, tables."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from blender_scenes import OBJECTS

from clsplat.comparison.runs import Run
from clsplat.comparison.table import Record, markdown_table
from clsplat.device.device import Device
from clsplat.errors import ClsplatError
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.scene import Scene, load_scene
from clsplat.scenes.split import hold_out
from clsplat.splats.color import BLACK, WHITE, Color

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
TEST_HELPERS = [str(ROOT / "tests"), str(ROOT / "tests" / "support")]  # for sys.path: the reference and the helpers
CLSPLAT = [sys.executable, "-c", "from clsplat_cli.start import main; main()"]  # the command line, for subprocesses
TRANSPARENT = ("lego", "lego_full", *OBJECTS)  # scenes with transparent photos
REDUCTION = {"fox": 2}  # `resolution` of load_scene; the other scenes are read as they are


def _in_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an error of clsplat without its traceback, and others as Python does."""
    if isinstance(error, ClsplatError):
        print(f"error: {error}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def parser(
    doc: str | None,
    out: Path | None = None,
    *,
    device: bool = True,
    table: bool = True,
    smoke: bool = True,
    page: Path | None = None,
) -> argparse.ArgumentParser:
    """Return a parser with the flags that most benchmarks have. From then on, a wrong value is one line, as in clsplat.

    Parameters
    ----------
    doc : text of --help, usually the module's docstring.
    out : default of --out; None: no such flag.
    device, table, smoke : whether to add --device, --table and --smoke.
    page : the page that --page writes; None: no such flag.
    """
    sys.excepthook = _in_one_line
    result = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if device:
        result.add_argument("--device", help="OpenCL device, as for clsplat; default: the best")
    if out is not None:
        result.add_argument("--out", type=Path, default=out, help="where the results are written")
    if table:
        result.add_argument("--table", action="store_true", help="print the results in --out and run nothing")
    if smoke:
        result.add_argument("--smoke", action="store_true", help="a tiny case, for tests")
    if page is not None:
        what = f"write the tables of {page.relative_to(ROOT)}, and run nothing"
        result.add_argument("--page", action="store_true", help=what)
    return result


def data_folder() -> Path:
    """Return the folder of the real scenes: CLSPLAT_DATA, or shared/data beside the repository."""
    return Path(os.environ.get("CLSPLAT_DATA") or ROOT.parent / "shared" / "data")


def background_of(name: str) -> Color:
    """Return the background of a scene: white behind transparent photos, as published figures have, else black."""
    return WHITE if name in TRANSPARENT else BLACK


def real_scene(name: str, resolution: int | None = None, *, validate: bool = False, background: Color = BLACK) -> Scene:
    """Read a scene of the data folder, with every 8th view as a test view.

    Parameters
    ----------
    resolution : as of `load_scene`; None: the size at which benchmarks train this scene.
    validate : replace the test views by held-out training views, so that choices can be made on them.
    background : color behind transparent photos.
    """
    resolution = REDUCTION.get(name, -1) if resolution is None else resolution
    scene = load_scene(data_folder() / name, resolution=resolution, eval=True, background=background)
    return hold_out(scene) if validate else scene


@dataclass(frozen=True)
class Case:
    """A scene at one size with one cap and one length of the run."""

    scene: str
    resolution: int
    cap: int
    iterations: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the case of scene:resolution:cap:iterations, and of further numbers if there are more."""
        name, *numbers = text.split(":")
        return cls(name, *map(int, numbers))

    def load(self, views: str) -> Scene:
        """Return the scene with its test views, or for `views` "validation" with held-out training views instead."""
        return real_scene(
            self.scene, self.resolution, validate=views == "validation", background=background_of(self.scene)
        )


def commit() -> str:
    """Return the short hash of the measured code, with "+" if the kernels or the library differ from it."""

    def git(*args: str) -> str:
        return subprocess.run(["git", *args], cwd=ROOT, capture_output=True, text=True, encoding="utf-8").stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "cl", "clsplat") else "")


def environment(device: Device, schedule: object) -> dict[str, Any]:
    """Return device, driver, schedule, commit and cores: where a result was measured.

    schedule : that of the kernels; None for the one that runs on the device take.
    """
    info = device.info
    return {
        "device": info.name,
        "platform": info.platform,
        "driver": info.driver,
        "schedule": str(schedule or schedule_for(device)),
        "commit": commit(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
    }


def load_average(minutes: int = 1) -> float:
    """Return the mean number of waiting processes over the last 1, 5 or 15 minutes; NaN on Windows."""
    return os.getloadavg()[(1, 5, 15).index(minutes)] if hasattr(os, "getloadavg") else float("nan")


def append(path: Path, row: Mapping[str, Any]) -> None:
    """Add one JSON line to a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(row) + "\n")


def read(path: Path) -> list[dict[str, Any]]:
    """Return all JSON lines of a file; no line if the file is missing."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


class Runs:
    """Finished runs in a file of JSON lines. A benchmark that was killed skips them when it is started again.

    Parameters
    ----------
    path : the file; it is read again for each question, so that two processes may share it.
    key : names of the values that identify a run.
    """

    def __init__(self, path: Path, key: Sequence[str]) -> None:
        self.path, self.key = path, tuple(key)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """All runs in the file."""
        return read(self.path)

    def identity(self, row: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return the values of the key."""
        return tuple(row[name] for name in self.key)

    def __contains__(self, row: Mapping[str, Any]) -> bool:
        """Whether the file has a run with the same values of the key."""
        identity = self.identity(row)
        return any(self.identity(other) == identity for other in self.rows)

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a finished run."""
        append(self.path, row)


def groups(rows: Iterable[dict[str, Any]], *names: str) -> dict[tuple[Any, ...], list[dict[str, Any]]]:
    """Collect rows that agree in the named values, in the order of their first rows."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in names), []).append(row)
    return found


def spread(values: Sequence[float]) -> str:
    """Return the standard deviation of several values, as the end of a cell; nothing for one value."""
    return f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""


def table(head: Sequence[str], rows: Iterable[Sequence[object]], right: Collection[str] = ()) -> str:
    """Return a Markdown table.

    Parameters
    ----------
    head : titles of the columns. rows : cells, converted by `str`. right : titles of right-aligned columns.
    """
    return markdown_table(head, [[str(cell) for cell in row] for row in rows], right)


def write_between(path: Path, begin: str, end: str, text: str) -> None:
    """Replace what stands between two marks of a page."""
    page = path.read_text(encoding="utf-8")
    start = page.index(begin) + len(begin)
    path.write_text(f"{page[:start]}\n\n{text}\n\n{page[page.index(end) :]}", encoding="utf-8")


def print_run(run: Run, record: Record | None) -> None:
    """Print one line after each run of a comparison; a callback for `compare`."""
    if record is not None:
        result = record["failed"] or f"{record['psnr']:.3f} dB, {record['splats']} splats, {record['seconds']:.1f} s"
        print(f"{run}: {result}", file=sys.stderr, flush=True)
