"""Structure from motion in a child process: it is started, watched, and ended with its parent."""

from __future__ import annotations

import json
import os
import queue
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError, Remedy
from ...files.masks import MASK_FOLDER
from ...files.real_path import real_path

_NEW_GROUP: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)  # what a session is elsewhere, on Windows
_POLL = 0.3  # time between two queries of the database [s]
# The number of rows of these tables shows the progress of a stage.
_TABLES = {"features": "keypoints", "pairs": "two_view_geometries", "pairs again": "two_view_geometries"}
_LABELS = {"features": "photos searched for features", "pairs": "pairs matched", "pairs again": "pairs matched again"}


@dataclass(frozen=True)
class Step:
    """Progress of the work: `done` of `total` items described by `label`; `total` is 0 if unknown."""

    label: str
    done: int
    total: int = 0


StepCallback = Callable[[Step], None]


def run_sfm(work: Path, job: dict[str, Any], report: StepCallback, source: str) -> dict[str, int]:
    """Find features, match pairs of photos, and map.

    Parameters
    ----------
    work : folder with photos/ and pairs.txt.
    job : the other values of the job that sfm_worker.py describes.
    report : called with each Step.
    source : name of the photos, for messages.

    Returns
    -------
    Number of registered photos of each model, by the model's folder.

    Raises
    ------
    InputError : the photos give no model, or pycolmap failed.
    """
    work = real_path(work)
    database = work / "database.db"
    whole = job | {
        "database": str(database),
        "photos": str(work / "photos"),
        "pairs": str(work / "pairs.txt"),
        "output": str(work / "sparse"),
    }
    (work / "job.json").write_text(json.dumps(whole), encoding="utf-8")
    log = work / "log.txt"
    with log.open("wb") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.sfm_worker", str(work / "job.json")],
            stderr=errors,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=_environment(),
            start_new_session=True,  # Ctrl-C is for this process, which then ends the child
            creationflags=_NEW_GROUP,
        )
    try:
        last = _watch(child, database, report)
    finally:
        child.kill()
        child.wait()
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                stream.close()
    if "models" not in last:
        raise InputError(
            f"{source}: structure from motion failed ({_reason(last, child.returncode, log)})",
            Remedy("try other photos"),
            Remedy("look for features on smaller photos", "--max-size PX"),
        )
    models: dict[str, int] = last["models"]
    if not models:
        raise InputError(
            f"{source}: no two photos fit together, so none has a pose; take sharp photos that overlap by "
            "more than half, of a scene at rest and with texture"
            + (f", and look at the masks in {Path(source) / MASK_FOLDER}: black hides" if job["masks"] else "")
        )
    return models


def _watch(child: subprocess.Popen[bytes], database: Path, report: StepCallback) -> dict[str, Any]:
    """Report the child's steps until it ends, and return its last event."""
    events: queue.Queue[dict[str, Any] | None] = queue.Queue()
    threading.Thread(target=_listen, args=(child, events), daemon=True).start()
    last: dict[str, Any] = {}
    stage, total = "", 0
    while True:
        try:
            event = events.get(timeout=_POLL)
        except queue.Empty:
            event = {}
        if event is None:
            return last
        last = event or last
        if "stage" in event:
            if stage in _TABLES:
                report(Step(_LABELS[stage], total, total))
            stage, total = event["stage"], event["total"]
        elif "done" in event:
            report(Step(stage, event["done"], total))
        elif stage in _TABLES and not event:
            report(Step(_LABELS[stage], min(_count_rows(database, _TABLES[stage]), total), total))


def _listen(child: subprocess.Popen[bytes], events: queue.Queue[dict[str, Any] | None]) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        try:
            event = json.loads(line)
        except ValueError:  # pycolmap prints lines that are not JSON
            continue
        if isinstance(event, dict):
            events.put(event)
    events.put(None)


def _count_rows(database: Path, table: str) -> int:
    """Return the current number of rows of a table; 0 while it cannot be read."""
    try:
        connection = sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=_POLL)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        finally:
            connection.close()
    except sqlite3.Error:
        return 0


def _reason(last: dict[str, Any], code: int, log: Path) -> str:
    if "error" in last:
        return str(last["error"])
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    ended = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"{ended}: {lines[-1][:160]}" if lines else ended


def _environment() -> dict[str, str]:
    """Return an environment in which the child imports this package from the same place."""
    home = str(Path(__file__).resolve().parents[3])
    paths = [home, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
