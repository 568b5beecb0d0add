"""Damaged files for every reader. Worker processes try them, so that crashes of the readers do not end the campaign.

    python tests/support/fuzzing.py TABLE READER,... FIRST COUNT SEED   # the worker

For each input, a correct reader raises a ClsplatError of one line or returns a result that its check accepts. Faults
are other exceptions, messages of several lines, a reader that takes longer than SECONDS, and a worker that dies. The
worker's address space is limited, so that MemoryError is a fault too. An input depends only on its reader, its number
and the seed.
"""

from __future__ import annotations

import copy
import gzip
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 10
ROOM = 1 << 30  # additional address space for the worker [bytes]; samples have a few kB
_ODD_BYTES = [
    b"\0" * 8,
    b"\xff" * 8,
    b"\xff" * 4,
    b"\xff\xff\xff\x7f",
    b"\0\0\xc0\x7f",
    b"\0\0\x80\x7f",
    np.float64(np.nan).tobytes(),
    np.float64(np.inf).tobytes(),
    np.float64(1e300).tobytes(),
    (1 << 40).to_bytes(8, "little"),
    (1 << 62).to_bytes(8, "little"),
    (1 << 31).to_bytes(4, "little"),
    b"\n",
    b" ",
    b"-",
    b'"',
    b"\xc3\x28",
    b"nan",
    b" 1e999 ",
    b" -1 ",
    b" 99999999999999999999 ",
    b"0x10",
]
_ODD_VALUES: list[Any] = [
    None,
    True,
    "",
    "x",
    "\0",
    "a\nb",
    -1,
    0,
    1,
    2.5,
    1e300,
    -1e300,
    10**30,
    float("nan"),
    float("inf"),
    [],
    [1],
    [[]],
    {},
    {"a": 1},
    "../../etc",
    "/",
    ".",
    "é" * 300,
    "é" * 300 + "/a.png",
    "a/" * 3000,
    "\ud800",
    [None] * 4,
]


class TooLong(BaseException):
    """Error that the worker's timer raises. No reader catches it."""


@dataclass
class Campaign:
    """Results of a reader: the numbers of inputs and of refused inputs, and the faults."""

    reader: str
    inputs: int = 0
    refused: int = 0
    faults: list[dict[str, Any]] = field(default_factory=list)


def campaign(readers: Sequence[str], count: int, seed: int = 0, table: str = "fuzz_readers") -> list[Campaign]:
    """Try `count` inputs of each reader in a worker process.

    If an input kills the worker, a new worker starts with the next input.

    Parameters
    ----------
    table : name of the module whose READERS contains the readers.
    """
    results, first = {reader: Campaign(reader) for reader in readers}, 0
    remaining = list(readers)
    while remaining:
        command = [sys.executable, __file__, table, ",".join(remaining), str(first), str(count), str(seed)]
        reader = remaining[0]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8"
        ) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            for line in process.stdout:
                event = json.loads(line)
                if "begun" in event:
                    reader, first = event["begun"]
                    results[reader].inputs += 1
                elif "fault" in event:
                    results[reader].faults.append({"reader": reader, "seed": seed, "input": first} | event)
                else:
                    results[reader].refused += 1
            errors, code = process.stderr.read(), process.wait()
        if code == 0:
            break
        results[reader].faults.append(
            {"reader": reader, "seed": seed, "input": first, "fault": f"the process ended ({code}): {errors[-300:]}"}
        )
        remaining = remaining[remaining.index(reader) :]
        first += 1
    return list(results.values())


def work(table: str, readers: str, first: int, count: int, seed: int) -> None:
    """Try inputs in this process. The first reader starts at input `first`."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _too_long)
    for reader in readers.split(","):
        with tempfile.TemporaryDirectory() as parent:
            sample = importlib.import_module(table).READERS[reader]
            folder = Path(parent) / "sample"
            folder.mkdir()
            sample.make(folder)
            pristine = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
            sample.read(folder)  # loads the reader's modules before memory is limited
            pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
            _, limit = resource.getrlimit(resource.RLIMIT_AS)
            resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ROOM, limit))
            damaged = {path: data for path, data in pristine.items() if sample.damaged in str(path)}
            for index in range(first, count):
                print(json.dumps({"begun": [reader, index]}), flush=True)
                # The seed uses neither the folder's name nor Python's hash, so that inputs are equal in all processes.
                rng = np.random.default_rng([seed, index, *reader.encode()])
                changed = damage(damaged, rng)
                fault = _fault(sample, folder)
                if fault is None:
                    print(json.dumps({"refused": True}), flush=True)
                elif fault:
                    names = [str(path.relative_to(folder)) for path in changed]
                    print(json.dumps({"files": names, "fault": fault}), flush=True)
                _restore(changed, pristine)
        first = 0


def _fault(sample: Any, folder: Path) -> str | None:
    """Return the reader's fault, "" if it returned a correct result, or None if it refused the input."""
    from clsplat.errors import ClsplatError

    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        sample.read(folder)
    except ClsplatError as error:
        message = str(error)
        sound = "\n" not in message and message.strip()
        return None if sound else f"message of several lines, or empty: {message[:300]!r}"
    except TooLong:
        return f"took longer than {SECONDS} s"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-4:]
        where = " < ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in reversed(place))
        return f"{type(error).__name__}: {str(error)[:200]} at {where}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return ""


def damage(pristine: dict[Path, bytes], rng: np.random.Generator) -> list[Path]:
    """Change one or two of the files and return their paths."""
    files = sorted(pristine)
    chosen = [files[i] for i in rng.permutation(len(files))[: 1 + (rng.random() < 0.2)]]
    for path in chosen:
        if rng.random() < 0.04:
            _replace(path, rng)
            continue
        data = pristine[path]
        try:
            _damage_inside(path, data, rng)
        except (OSError, ValueError, EOFError, zlib.error, zipfile.BadZipFile):  # an earlier step has damaged it
            path.write_bytes(odd_bytes(data, rng))
    return chosen


def _damage_inside(path: Path, data: bytes, rng: np.random.Generator) -> None:
    """Write other values into the structure of an intact file. A file without a structure gets other bytes."""
    structured = _json_of(data)
    if structured is not None and rng.random() < 0.7:
        path.write_bytes(odd_json(structured, rng))
    elif path.suffix == ".npz" and rng.random() < 0.8:
        _odd_npz(path, rng)
    elif data.startswith(b"\x1f\x8b") and rng.random() < 0.8:  # inside gzip, so that its checksum stays correct
        path.write_bytes(gzip.compress(odd_bytes(gzip.decompress(data), rng)))
    else:
        path.write_bytes(odd_bytes(data, rng))


def odd_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the bytes with one to four changes."""
    raw = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        # Half of the changes are in the first kB, which has headers and counts.
        span = len(raw) if rng.random() < 0.5 else min(len(raw), 1024)
        at = int(rng.integers(0, max(span, 1)))
        kind = rng.integers(8)
        if kind == 0 and raw:
            raw[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and raw:
            raw[at] = int(rng.integers(256))
        elif kind == 2:
            del raw[at:]
        elif kind == 3:
            del raw[at : at + int(rng.integers(1, 40))]
        elif kind == 4:
            raw[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 5:
            odd = _ODD_BYTES[rng.integers(len(_ODD_BYTES))]
            raw[at : at + len(odd)] = odd
        elif kind == 6:
            odd = _ODD_BYTES[rng.integers(len(_ODD_BYTES))]
            at -= at % 4  # most counts and numbers are aligned
            raw[at : at + len(odd)] = odd
        else:
            raw[at:at] = raw[at : at + int(rng.integers(1, 200))]
    return bytes(raw)


def odd_json(values: Any, rng: np.random.Generator) -> bytes:
    """Return JSON with one to three values replaced, removed or repeated, or sometimes deeply nested JSON."""
    values = json.loads(json.dumps(values))
    if rng.random() < 0.03:
        return b"[" * 100_000 if rng.random() < 0.5 else b'{"a":' * 50_000 + b"1" + b"}" * 50_000
    for _ in range(int(rng.integers(1, 4))):
        parents: list[Any] = []
        _containers(values, parents)
        if not parents:
            break
        parent = parents[rng.integers(len(parents))]
        keys = list(parent) if isinstance(parent, dict) else list(range(len(parent)))
        odd = copy.deepcopy(_ODD_VALUES[rng.integers(len(_ODD_VALUES))])
        if not keys:
            continue
        key = keys[rng.integers(len(keys))]
        kind = rng.integers(4)
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, list):
            parent.insert(key, parent[key])
        else:
            parent[key] = odd
    return json.dumps(values).encode()


def _containers(values: Any, containers: list[Any]) -> None:
    """Append all lists and objects inside a value."""
    if isinstance(values, dict | list):
        containers.append(values)
        for part in values.values() if isinstance(values, dict) else values:
            _containers(part, containers)


def _json_of(data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        return None


def _odd_npz(path: Path, rng: np.random.Generator) -> None:
    """Write an intact archive of damaged arrays, because the zip format's checksums detect all other damage."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = sorted(arrays)[rng.integers(len(arrays))] if rng.random() < 0.5 else "meta"
    if name == "meta":
        arrays["meta"] = np.frombuffer(odd_json(json.loads(arrays["meta"].tobytes()), rng), np.uint8)
    else:
        odd: list[Any] = [
            arrays[name][:-1],
            arrays[name].astype(str),
            np.full_like(arrays[name], -1),
            np.zeros(3),
            arrays[name].astype(np.float64) * np.nan,
            arrays[name][..., None],
            np.float32(1.0),
        ]
        kind = int(rng.integers(len(odd) + 1))
        if kind == len(odd):
            del arrays[name]
        else:
            arrays[name] = odd[kind]
    np.savez(path, **arrays)


def _replace(path: Path, rng: np.random.Generator) -> None:
    """Delete a file, or replace it by an empty file, a folder, a link to itself, a broken link, or another name."""
    path.unlink()
    kind = rng.integers(6)
    if kind == 1:
        path.write_bytes(b"")
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        path.symlink_to(path)
    elif kind == 4:
        path.symlink_to("/nonexistent/file")
    elif kind == 5:
        os.rename(path.parent, path.parent.with_name("moved"))
        path.parent.mkdir()
        for other in path.parent.with_name("moved").iterdir():
            # The file is gone, and another file with a name that is not text is in its folder.
            other.rename(path.parent / other.name)
        path.parent.with_name("moved").rmdir()
        (Path(os.fsdecode(os.fsencode(path.parent) + b"/\xff\xfe" + os.fsencode(path.suffix)))).write_bytes(b"x")


def _restore(changed: list[Path], pristine: dict[Path, bytes]) -> None:
    for path in changed:
        if path.is_symlink() or path.is_file():
            path.unlink()
        elif path.is_dir():
            path.rmdir()
        for odd in path.parent.iterdir():
            if b"\xff\xfe" in os.fsencode(odd.name):
                odd.unlink()
        path.write_bytes(pristine[path])


def _too_long(*_: object) -> None:
    raise TooLong


if __name__ == "__main__":
    work(*sys.argv[1:3], *map(int, sys.argv[3:6]))
