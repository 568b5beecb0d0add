"""What every benchmark writes beside its numbers, and JSON lines that can be resumed."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from clsplat.device.device import Device

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def data_folder() -> Path:
    """Folder of the real scenes: CLSPLAT_DATA, or shared/data beside the repository."""
    return Path(os.environ.get("CLSPLAT_DATA") or ROOT.parent / "shared" / "data")


def commit() -> str:
    """Short hash of the code measured, with "+" when the kernels or the library differ from it."""

    def git(*args: str) -> str:
        return subprocess.run(["git", *args], cwd=ROOT, capture_output=True, text=True).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "cl", "clsplat") else "")


def environment(device: Device, schedule: object) -> dict[str, Any]:
    """Device, driver, schedule, commit and cores."""
    info = device.info
    return {
        "device": info.name,
        "platform": info.platform,
        "driver": info.driver,
        "schedule": str(schedule),
        "commit": commit(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
    }


def append(path: Path, row: dict[str, Any]) -> None:
    """One JSON line more."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as stream:
        stream.write(json.dumps(row) + "\n")


def read(path: Path) -> list[dict[str, Any]]:
    """All JSON lines; none when the file is missing."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
