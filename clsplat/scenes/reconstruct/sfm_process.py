"""Structure from motion in a child process: started, watched and told of, ended with its parent."""

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

from ...errors import InputError

_LOOK = 0.3  # seconds between looks at the database
# The table whose rows tell how far a stage is.
_COUNTED = {"features": "keypoints", "pairs": "two_view_geometries", "pairs again": "two_view_geometries"}
_SAID = {"features": "photos searched for features", "pairs": "pairs matched", "pairs again": "pairs matched again"}


@dataclass(frozen=True)
class Step:
    """How far the work is: `done` of `total` (0 where it is not known) of what `label` says."""

    label: str
    done: int
    total: int = 0


Tell = Callable[[Step], None]


def run_sfm(work: Path, job: dict[str, Any], tell: Tell, source: str) -> dict[str, int]:
    """Find features, match and map.

    Parameters
    ----------
    work : folder with photos/ and pairs.txt. job : the rest of what sfm.py wants.
    source : the photographs, for messages.

    Returns
    -------
    How many photos each model registers, by its folder.

    Raises
    ------
    InputError : no model comes of the photos, or the library failed.
    """
    work = work.resolve()
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
            start_new_session=True,
        )
    try:
        last = _watch(child, database, tell)
    finally:
        child.kill()
        child.wait()
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                stream.close()
    if "models" not in last:
        raise InputError(
            f"{source}: structure from motion failed ({_reason(last, child.returncode, log)}); try other "
            "photos, or a smaller --max-size"
        )
    models: dict[str, int] = last["models"]
    if not models:
        raise InputError(
            f"{source}: no two photos fit together, so none has a pose; take photos that overlap by more "
            "than half, sharp, of things at rest and with texture"
        )
    return models


def _watch(child: subprocess.Popen[bytes], database: Path, tell: Tell) -> dict[str, Any]:
    """Tell of the child's steps until it ends; returns what it said last."""
    events: queue.Queue[dict[str, Any] | None] = queue.Queue()
    threading.Thread(target=_listen, args=(child, events), daemon=True).start()
    last: dict[str, Any] = {}
    stage, total = "", 0
    while True:
        try:
            event = events.get(timeout=_LOOK)
        except queue.Empty:
            event = {}
        if event is None:
            return last
        last = event or last
        if "stage" in event:
            if stage in _COUNTED:
                tell(Step(_SAID[stage], total, total))
            stage, total = event["stage"], event["total"]
        elif "done" in event:
            tell(Step(stage, event["done"], total))
        elif stage in _COUNTED and not event:
            tell(Step(_SAID[stage], min(_rows(database, _COUNTED[stage]), total), total))


def _listen(child: subprocess.Popen[bytes], events: queue.Queue[dict[str, Any] | None]) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        try:
            event = json.loads(line)
        except ValueError:  # the library's own words
            continue
        if isinstance(event, dict):
            events.put(event)
    events.put(None)


def _rows(database: Path, table: str) -> int:
    """Rows of a table so far; 0 while it cannot be read."""
    try:
        connection = sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=_LOOK)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        finally:
            connection.close()
    except sqlite3.Error:
        return 0


def _reason(last: dict[str, Any], code: int, log: Path) -> str:
    if "error" in last:
        return str(last["error"])
    said = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    ended = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"{ended}: {said[-1][:160]}" if said else ended


def _environment() -> dict[str, str]:
    """So that the child finds this package where this process found it."""
    home = str(Path(__file__).resolve().parents[3])
    paths = [home, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
