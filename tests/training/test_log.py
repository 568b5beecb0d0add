"""log.jsonl after interruptions: no line is repeated or lost, whatever the file contains."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from clsplat.errors import OutputError
from clsplat.training import log as run_log
from clsplat.training.log import RunLog


def iterations(path: Path) -> list[int]:
    return [json.loads(line)["iteration"] for line in path.read_text().splitlines()]


def test_a_resumed_log_goes_on_where_the_checkpoint_is(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    lines = [
        b'{"iteration": 50}',
        b'{"iteration": 100}',
        b"\xff\xfe no text",
        b"7",
        b'{"iteration": "x"}',
        b"[]",
        b'{"iteration": 150}',
        b'{"iteration": 20',
        b'{"iteration": 1e999}',
        b"[" * 100_000,
    ]
    path.write_bytes(b"\n".join(lines))
    log = RunLog(path, 100)
    assert iterations(path) == [50, 100], "written before anything else happens"
    log.write({"iteration": 150})
    assert iterations(path) == [50, 100, 150]
    RunLog(path, 0)
    assert path.read_bytes() == b"", "a run from the start"
    RunLog(None, 0).write({"iteration": 1})


def test_a_crash_while_it_is_cut_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text('{"iteration": 50}\n{"iteration": 100}\n')

    def crash(path: Path) -> None:
        raise OutputError("disk full")

    monkeypatch.setattr(run_log, "atomic_writer", crash)
    with pytest.raises(OutputError, match="disk full"):
        RunLog(path, 50)
    assert iterations(path) == [50, 100]
