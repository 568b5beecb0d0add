"""The state of a run between two iterations, in one file written whole or not at all."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_writer
from .errors import InputError
from .schema import Array

VERSION = 2


@dataclass(frozen=True)
class Checkpoint:
    """Everything that the rest of a run depends on.

    Parameters
    ----------
    iteration : iterations done.
    config : of the run, as JSON.
    splats : public arrays by field.
    optimizer : its state by key.
    rng : state of the NumPy generator, as JSON.
    queue : training views still to come in this epoch.
    seconds : training time so far. schedule : of the kernels, whose rounding depends on it.
    n_first : splats at the start, which the growth depends on.
    signals : (3, N), see Pipeline.signals.
    """

    iteration: int
    config: dict[str, Any]
    splats: dict[str, Array]
    optimizer: dict[str, NDArray[Any]]
    rng: dict[str, Any]
    queue: list[int]
    seconds: float
    schedule: str
    n_first: int
    signals: Array

    def save(self, path: Path) -> None:
        """Write; raises OutputError when the disk is full or the folder read-only (the old file stays)."""
        meta = {"version": VERSION, "iteration": self.iteration, "config": self.config, "rng": self.rng,
                "queue": self.queue, "seconds": self.seconds, "schedule": self.schedule,
                "n_first": self.n_first}
        arrays = {f"splats.{k}": v for k, v in self.splats.items()}
        arrays |= {f"optimizer.{k}": v for k, v in self.optimizer.items()}
        arrays["signals"] = self.signals
        arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
        with atomic_writer(path) as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Read; raises InputError when the file is missing, damaged or of another version."""
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            meta = json.loads(arrays.pop("meta").tobytes())
            signals = arrays.pop("signals")
        except FileNotFoundError:
            raise InputError(f"{path}: no checkpoint to resume from: start without --resume") from None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: not a readable checkpoint ({error}): "
                             "start again with --overwrite") from None
        if meta.get("version") != VERSION:
            found = meta.get("version")
            raise InputError(f"{path}: checkpoint version {found}, this clsplat reads {VERSION}")

        def part(prefix: str) -> dict[str, Any]:
            return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}

        return cls(meta["iteration"], meta["config"], part("splats."), part("optimizer."), meta["rng"],
                   meta["queue"], meta["seconds"], meta["schedule"],
                   meta["n_first"], signals)
