"""runs.jsonl: the finished runs of a comparison, one line each."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError
from ..files.atomic import atomic_writer
from ..files.file_names import short_name
from ..training.config import FREE_OPTIONS, TrainConfig
from .run_rows import parse_runs, torn_tail
from .scene_identity import with_contents
from .table import Record

RUNS = "runs.jsonl"
_LONGEST_NAME = 200  # of a run's files, without digits and a suffix [bytes]; most file systems allow 255


@dataclass(frozen=True)
class Run:
    """One training run of a comparison: the `number`th of `total` on its scene; `repeat`s of a run are 1, 2, ..."""

    scene: str
    system: str
    config: TrainConfig
    number: int
    total: int
    repeat: int = 0

    def __str__(self) -> str:
        config = self.config
        again = f" repeat {self.repeat}" if self.repeat else ""
        return f"[{self.number}/{self.total}] {self.scene} {self.system} cap {config.cap_max} seed {config.seed}{again}"

    @property
    def file_name(self) -> str:
        """Name of the run's files, without their suffix: scene, system, cap, seed and repeat."""
        return short_name(f"{self.scene}-{self.stem}", _LONGEST_NAME)

    def model_name(self, test_views: int) -> str:
        """Return the name of the run's model, without digits and a suffix: that of its files, length and test views."""
        return f"{self.file_name}-iterations{self.config.iterations}-test{test_views}"

    @property
    def stem(self) -> str:
        """The part of file names that differs between runs on a scene: system, cap, seed and repeat."""
        again = f"-repeat{self.repeat}" if self.repeat else ""
        return re.sub(r"[^\w.=,-]", "_", f"{self.system}-cap{self.config.cap_max}-seed{self.config.seed}{again}")


class RunFile:
    """The finished runs of a folder: each run is appended to runs.jsonl, and a repeated run replaces its line.

    Raises
    ------
    OutputError : the folder or the file cannot be used. InputError : a row of the file is damaged (`parse_runs`).
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / RUNS
        text = ""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                text = self.path.read_bytes().decode()
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"{self.path}: cannot be used ({reason}): choose another folder") from None
        self.records = parse_runs(text, self.path)
        whole = text.removesuffix(torn_tail(text))
        self._end = len(whole.encode()) if whole != text else None  # of the whole lines [bytes], before a torn one
        text = whole
        self._separator = "" if not text or text.endswith("\n") else "\n"

    def find(self, scene: Mapping[str, Any], system: str, config: TrainConfig, repeat: int = 0) -> Record | None:
        """Return the record of a run; None if the run is not finished.

        A row of an older version has no digest of its scene. It is the record of a run if all else is equal, unless
        the file has another digest for such a scene already (`with_contents`).
        """
        place = self._place({"scene": scene, "system": system, "config": config.to_json(), "repeat": repeat})
        return None if place is None else self.records[place]

    def _place(self, record: Mapping[str, Any]) -> int | None:
        """Return the index of the record of the same run; None if there is none."""
        *keys, key = map(run_key, with_contents([*self.records, dict(record)]))
        return next((place for place, other in enumerate(keys) if other == key), None)

    def add(self, record: Record) -> None:
        """Append a record, or replace the record of the same run; raises OutputError if it cannot be written."""
        record = json.loads(json.dumps(record))
        place = self._place(record)
        if place is not None:
            self.records[place] = record
            self._write()
            return
        try:
            if self._end is not None:
                os.truncate(self.path, self._end)
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(self._separator + json.dumps(record) + "\n")
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror or error}): free some space") from None
        self._separator, self._end = "", None
        self.records.append(record)

    def arrange(self, order: Sequence[Mapping[str, Any]]) -> None:
        """Put the lines of some runs into an order, behind all others. order : the start of their records."""
        places = {run_key(record): place for place, record in enumerate(order)}
        arranged = sorted(self.records, key=lambda record: places.get(run_key(record), -1))
        if arranged != self.records:
            self.records = arranged
            self._write()

    def _write(self) -> None:
        with atomic_writer(self.path) as whole:
            whole.write("".join(json.dumps(line) + "\n" for line in self.records).encode())
        self._separator, self._end = "", None


def refuse_foreign(folder: Path, names: Sequence[str]) -> None:
    """Raise OutputError if a file of a comparison would replace one that no comparison wrote.

    Parameters
    ----------
    folder : of the comparison. It is one that a comparison wrote if it has runs.jsonl.
    names : files and folders in it that will be written.
    """
    if not (folder / RUNS).exists():
        for path in (folder / name for name in names):
            if path.exists():
                raise OutputError(f"{path}: exists already, but no {RUNS} beside it: choose another folder")


def read_runs(path: str | Path) -> list[Record]:
    """Return the records of a runs.jsonl, or of the one in a folder.

    Raises
    ------
    InputError : the file is missing or cannot be read, or a row is damaged (`parse_runs`).
    """
    file = Path(path)
    file = file / RUNS if file.is_dir() else file
    try:
        text = file.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{file}: cannot be read ({reason}): give the folder of a comparison, or its {RUNS}") from None
    return parse_runs(text, file)


def distinct(records: Sequence[Record]) -> list[Record]:
    """Return the records without later records of the same run."""
    kept: dict[str, Record] = {}
    for record, known in zip(records, with_contents(records), strict=True):
        kept.setdefault(run_key(known), record)
    return list(kept.values())


def run_key(record: Mapping[str, Any]) -> str:
    """Return what identifies a run: scene, system, the options that change the result, and the number of the repeat."""
    options = {key: value for key, value in record["config"].items() if key not in FREE_OPTIONS}
    return json.dumps([record["scene"], record["system"], options, record.get("repeat", 0)], sort_keys=True)


def key_digest(record: Mapping[str, Any]) -> str:
    """Return eight digits that differ between runs with different options, so that no run replaces another."""
    return hashlib.sha256(run_key(record).encode()).hexdigest()[:8]
