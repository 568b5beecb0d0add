"""Sweeps on workers: how much faster two are than one, whether the rows are the same, and what kills do to them.

    python benchmarks/cluster.py                # both measurements; a few minutes on two cores
    python benchmarks/cluster.py --page         # write the table of docs/cluster.md
    python benchmarks/cluster.py --smoke

The sweep has 24 runs: four systems, two caps and three seeds on fox at a quarter of its size. One worker with one core
does it, then two workers with one core each. A third sweep has two workers, too, and they are killed at
random moments, as often as `--kills` says.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from common import CLSPLAT, RESULTS, ROOT, Runs, data_folder, environment, parser, table, write_between

from clsplat.device.device import open_device
from clsplat.rendering.tuning import schedule_for

KEY = ("case", "runs", "workers")
PAGE = ROOT / "docs" / "cluster.md"
MARKS = ("<!-- table of cluster.py -->", "<!-- end of the table of cluster.py -->")
SYSTEMS, CAPS, SEEDS = "gaussian,default,3dgs,3dgs-mcmc", "2000,8000", "0,1,2"
# Keys of a line that differ between two equal runs.
TIMES = {"seconds", "cpu_seconds", "render_ms", "peak_bytes", "device_bytes"}


def sweep(scene: Path, out: Path, cluster: str, size: list[str], cores: set[int], on_start: Any = None) -> float:
    """Run `clsplat compare` and return its seconds. size : more arguments. cores : that the command may use."""
    command = [*CLSPLAT, "compare", str(scene), "-o", str(out), *size, "--cluster", cluster, "-q"]
    start = time.perf_counter()
    process = subprocess.Popen(command, preexec_fn=lambda: os.sched_setaffinity(0, cores))
    if on_start is not None:
        on_start(process)
    if process.wait():
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    return time.perf_counter() - start


def rows(out: Path) -> list[dict[str, Any]]:
    """Return the lines of runs.jsonl without times and memory."""
    lines = (out / "runs.jsonl").read_text(encoding="utf-8").splitlines()
    return [{key: value for key, value in json.loads(line).items() if key not in TIMES} for line in lines]


class Killer:
    """Kills the worker processes of a command at random moments.

    Parameters
    ----------
    kills : how often. mean : mean of the seconds between two.
    """

    def __init__(self, kills: int, mean: float) -> None:
        self.left, self.mean, self.done = kills, mean, 0
        self._random = random.Random(0)

    def __call__(self, process: subprocess.Popen[bytes]) -> None:
        threading.Thread(target=self._kill, args=(process,), daemon=True).start()

    def _kill(self, process: subprocess.Popen[bytes]) -> None:
        while self.left and process.poll() is None:
            time.sleep(self._random.uniform(0.2, 2 * self.mean))
            victims = workers_of(process.pid)
            if victims:
                with suppress(ProcessLookupError):
                    os.kill(self._random.choice(victims), signal.SIGKILL)
                    self.left, self.done = self.left - 1, self.done + 1


def workers_of(parent: int) -> list[int]:
    """Return the worker processes that a process has started."""
    import psutil  # comes with dask.distributed

    with suppress(psutil.NoSuchProcess):
        return [child.pid for child in psutil.Process(parent).children() if "spawn_main" in " ".join(child.cmdline())]
    return []


def measure(args: argparse.Namespace) -> None:
    """Do the sweeps that are not in the results yet."""
    runs = Runs(args.out, KEY)
    scene, size, n_runs = data_folder() / "fox", ["-r", "4", "--iterations", "300"], 24
    size += ["--systems", SYSTEMS, "--cap-max", CAPS, "--seeds", SEEDS]
    if args.smoke:
        scene, n_runs = args.scene, 4
        size = ["--iterations", "30", "--systems", "gaussian,default", "--cap-max", "100", "--seeds", "0,1"]
    cores = sorted(os.sched_getaffinity(0))[:2]
    device = open_device()
    place = environment(device, schedule_for(device)) | {"load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as folder:
        one, two, killed = (Path(folder) / name for name in ("one", "two", "killed"))
        alone = sweep(scene, one, "local:1", size, {cores[0]})
        shared = sweep(scene, two, f"local:{len(cores)}", size, set(cores))
        expected = rows(one)
        assert len(expected) == n_runs
        same = rows(two) == expected
        runs.add({"case": "sweep", "runs": n_runs, "workers": 1, "seconds": alone} | place)
        runs.add(
            {"case": "sweep", "runs": n_runs, "workers": len(cores), "seconds": shared, "same_rows": same}
            | {"speed_up": alone / shared}
            | place
        )
        killer = Killer(args.kills, shared / args.kills)
        seconds = sweep(scene, killed, f"local:{len(cores)}", size, set(cores), killer)
        found = rows(killed)
        runs.add(
            {"case": "kills", "runs": n_runs, "workers": len(cores), "seconds": seconds, "kills": killer.done}
            | {"same_rows": found == expected, "lines": len(found)}
            | place
        )
    print(page(runs.rows))


def page(found: list[dict[str, Any]]) -> str:
    """Return a Markdown table of the sweeps."""
    lines = [
        (
            {"sweep": "sweep", "kills": f"sweep, {row.get('kills')} workers killed"}[row["case"]],
            row["workers"],
            row["runs"],
            f"{row['seconds']:.0f}",
            f"{row['speed_up']:.2f}" if "speed_up" in row else "",
            {True: "the same", False: "others", None: ""}[row.get("same_rows")],
        )
        for row in found
    ]
    head = ("", "workers", "runs", "seconds", "speed-up", "rows")
    return table(head, lines, right=head[1:5])


def main() -> None:
    flags = parser(__doc__, RESULTS / "cluster.jsonl", device=False, page=PAGE)
    flags.add_argument("--kills", type=int, default=20, help="number of workers to kill")
    flags.add_argument("--scene", type=Path, help="scene of --smoke")
    args = flags.parse_args()
    if args.page:
        write_between(PAGE, *MARKS, page(Runs(args.out, KEY).rows))
    elif args.table:
        print(page(Runs(args.out, KEY).rows))
    else:
        measure(args)


if __name__ == "__main__":
    sys.exit(main())
