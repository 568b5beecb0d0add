"""kill -9 at random moments of training, `--resume` after each, and a comparison with an uninterrupted run's bytes.

    python benchmarks/kill.py [--kills 50] [--seed 0] [--device 0:0]

Each run trains on a made capture of a few pixels, with a checkpoint every third iteration and many point clouds. So
files are being written half of the time. The kills are of three kinds, equally often: at any time after the start of
the process, some time after a checkpoint, and while a file is half written. Every tenth process begins with empty
caches of kernels. After each kill all files must be whole. Each run must end with the point clouds and the log columns
of the uninterrupted run, and with no other files in the folder. The script writes a JSON line.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import common
import numpy as np

from clsplat.device.device import open_device
from clsplat.errors import ClsplatError
from clsplat.scenes.demo.scene import write_capture
from clsplat.splats.splats import Splats
from clsplat.training.checkpoint import Checkpoint

ITERATIONS, INTERVAL = 240, 3
OPTIONS = [
    "--iterations",
    str(ITERATIONS),
    "--cap-max",
    "300",
    "--sh-degree",
    "1",
    "--densify-interval",
    "10",
    "--checkpoint-interval",
    str(INTERVAL),
    "--save-iterations",
    ",".join(map(str, range(20, ITERATIONS, 20))),
    "--test-iterations",
    "100,200",
    "--eval",
    "--quiet",
]
MOMENTS = ("any time", "after a checkpoint", "while writing")
TIMEOUT = 120  # seconds of a process
KILLED = -int(getattr(signal, "SIGKILL", -1))  # exit code of a killed process; 1 on Windows
CACHES = ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "CUDA_CACHE_PATH")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "kill.jsonl", table=False, smoke=False)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    device = open_device(args.device)
    with tempfile.TemporaryDirectory() as folder:
        row = Killer(Path(folder), device.info.index, args.seed).run(args.kills)
    # The schedule is fixed: with empty caches it would be measured again.
    common.append(args.out, common.environment(device, "cpu16") | {"seed": args.seed} | row)
    print(json.dumps(row, indent=1))
    sys.exit(1 if row["faults"] else 0)


class Killer:
    """Runs, kills them and collects the faults."""

    def __init__(self, folder: Path, device: str, seed: int) -> None:
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self.scene = write_capture(folder / "scene", 48, 36, 10)
        self.device = device
        self.environment = os.environ | {"CLSPLAT_SCHEDULE": "cpu16"}
        self.cold: list[str] = []
        self.kills: Counter[str] = Counter()
        self.at: list[int] = []
        self.processes, self.runs, self.faults = 0, 0, list[str]()

    def run(self, kills: int) -> dict[str, Any]:
        """Kill that number of times, let every run end, and return the report."""
        start = time.perf_counter()
        reference = self.folder / "reference"
        subprocess.run(self.command(reference), env=self.environment, check=True, timeout=TIMEOUT)
        self.seconds = time.perf_counter() - start
        while self.kills.total() < kills:
            self.runs += 1
            model = self.folder / f"run-{self.runs}"
            while self.kills.total() < kills and not self.process(model, str(self.rng.choice(MOMENTS))):
                self.check_files(model)
            self.process(model, "")
            self.check_files(model)
            self.compare(model, reference)
        return {
            "kills": self.kills.total(),
            "moments": dict(self.kills),
            "iterations killed at": sorted(self.at),
            "runs": self.runs,
            "processes": self.processes,
            "cold starts": len(self.cold),
            "faults": self.faults,
            "seconds": round(time.perf_counter() - start, 1),
        }

    def command(self, model: Path) -> list[str]:
        """Return the command that resumes from a checkpoint, or starts if there is none."""
        if (model / "checkpoint.npz").is_file():
            return [*common.CLSPLAT, "train", "--resume", "-m", str(model), "--device", self.device, "--quiet"]
        return [
            *common.CLSPLAT,
            "train",
            str(self.scene),
            "-m",
            str(model),
            "--device",
            self.device,
            "--overwrite",
            *OPTIONS,
        ]

    def process(self, model: Path, moment: str) -> bool:
        """Start a process and kill it at a moment ("": never); return whether it ended first."""
        self.processes += 1
        environment = self.environment
        if moment and self.processes % 10 == 1:
            caches = self.folder / f"caches-{self.processes}"
            caches.mkdir()
            self.cold.append(str(caches))
        if moment and self.cold and self.processes % 10 < 4:  # later starts find the caches of the first one
            environment = environment | dict.fromkeys(CACHES, self.cold[-1])
        checkpoint = model / "checkpoint.npz"
        before = stamp(checkpoint)
        errors = self.folder / "errors"
        with (
            errors.open("w", encoding="utf-8") as stream,
            subprocess.Popen(self.command(model), env=environment, stderr=stream) as child,
        ):
            killed = bool(moment) and self.wait(child, moment, checkpoint, before)
            if killed:
                child.kill()
            try:
                code = child.wait(TIMEOUT)
            except subprocess.TimeoutExpired:
                child.kill()
                self.faults.append(f"run {self.runs}: hung after {self.kills.total()} kills")
        if code == KILLED:
            self.kills[moment] += 1
            if checkpoint.is_file():
                self.at.append(Checkpoint.load(checkpoint).iteration)
            return False
        if code:
            self.faults.append(
                f"run {self.runs}: ended with {code} after {self.kills.total()} kills: "
                f"{errors.read_text(encoding='utf-8', errors='replace')[-300:]}"
            )
        return True

    def wait(self, child: subprocess.Popen[bytes], moment: str, checkpoint: Path, before: int) -> bool:
        """Wait until the moment; return whether the process is still running."""
        if moment == MOMENTS[0]:
            time.sleep(self.rng.uniform(0, 1.2 * self.seconds))
            return child.poll() is None
        writes = int(self.rng.integers(1, 12))  # half-written files until the kill
        while child.poll() is None:
            if moment == MOMENTS[1] and stamp(checkpoint) != before:
                time.sleep(self.rng.uniform(0, 0.4))
                return True
            if moment == MOMENTS[2] and any(checkpoint.parent.rglob(".*.tmp*")):
                writes -= 1
                if not writes:
                    return True
            time.sleep(0.0005)
        return False

    def check_files(self, model: Path) -> None:
        """Check that all files are whole."""
        place = f"run {self.runs}, after {self.kills.total()} kills"
        try:
            if (model / "checkpoint.npz").is_file():
                Checkpoint.load(model / "checkpoint.npz")
            for path in model.glob("point_cloud/*/point_cloud.ply"):
                Splats.load(path)
            for path in model.glob("[!.]*.json"):
                json.loads(path.read_bytes())
        except (ClsplatError, ValueError) as error:
            self.faults.append(f"{place}: {error}")

    def compare(self, model: Path, reference: Path) -> None:
        """Compare a finished run with the uninterrupted one."""
        place = f"run {self.runs}"
        names = [
            sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())
            for root in (model, reference)
        ]
        if names[0] != names[1]:
            self.faults.append(f"{place}: other files: {sorted(set(names[0]) ^ set(names[1]))}")
        for path in reference.glob("point_cloud/*/point_cloud.ply"):
            other = model / path.relative_to(reference)
            if not other.is_file() or other.read_bytes() != path.read_bytes():
                self.faults.append(f"{place}: {other.relative_to(model)} has other bytes")
        if timeless(model / "log.jsonl") != timeless(reference / "log.jsonl"):
            self.faults.append(f"{place}: log.jsonl has other lines")


def stamp(path: Path) -> int:
    """Return when a file was written [ns]; 0 if there is no file."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def timeless(log: Path) -> list[dict[str, Any]]:
    """Return the lines of a log without their times."""
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


if __name__ == "__main__":
    main()
