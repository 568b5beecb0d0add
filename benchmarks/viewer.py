"""How fast the viewer is: pictures a second, from a camera's move to its picture, and what watching costs a run.

    python benchmarks/viewer.py                      # moving and still, on the scenes' models
    python benchmarks/viewer.py --training           # runs with and without a watcher, in turn

The server is a process of its own; the client walks along a path between training cameras as a browser does: a pose
every 16 ms, whether pictures come or not, and decodes what comes. Each picture carries the number of its pose in its
corner, as blocks that JPEG keeps. Latency: from sending a pose to having decoded the first picture of it or of a later
one. After rest: from a single pose to the decoded first and full picture; the full one waits 150 ms for the camera to
rest, and without that wait it tells how many full ones there could be in a second.

Watching: the same run without a viewer, with one that nobody looks at, and with a client whose camera moves all the
time, in turn: wall time from the first line of the run to its last, that of the whole command, and processor time, which
tells more than the wall where the machine has other work.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

sys.path.insert(0, str(common.ROOT / "tests"))

KEYS, FRAMES = 4, 4000  # training cameras on the path, poses between them
POSE_SECONDS = 0.016
REST = 0.15  # seconds, of clsplat/viewer.py
BITS, BLOCK = 12, 8  # of a pose's number; side of a bit [px]
SCENES = {"fox": 2, "kitchen": -1}  # with their -r


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--models", type=Path, help="folder of trained models by scene; those missing are trained")
    parser.add_argument("--windows", nargs="*", default=["1280x720", "1920x1080"])
    parser.add_argument("--seconds", type=float, default=10.0, help="that the camera moves")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap-max", type=int, default=20000)
    parser.add_argument("--rounds", type=int, default=3, help="runs of each kind with --training")
    parser.add_argument("--training", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "viewer.jsonl")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(args.serve, args.device)
        return
    for scene in args.scenes:
        if args.training:
            watch_training(scene, args)
            continue
        with tempfile.TemporaryDirectory() as scratch:
            model = (args.models or Path(scratch)) / scene
            if not model.exists():
                subprocess.run(training_command(scene, model, args), check=True)
            for window in args.windows:
                walk(scene, model, window, args)


def training_command(scene: str, model: Path, args: argparse.Namespace) -> list[str]:
    """`clsplat train` of a scene."""
    device = ["--device", args.device] if args.device else []
    resolution = ["-r", str(SCENES[scene])] if scene in SCENES else []
    return [sys.executable, "-c", "from clsplat_cli.main import main; main()", "train",
            str(common.data_folder() / scene), *resolution, "-m", str(model), "--eval",
            "--iterations", str(args.iterations), "--cap-max", str(args.cap_max), *device]


# --- pictures --------------------------------------------------------------------------------


def path_of(model: Path) -> list[Any]:
    """Cameras on the way through some training cameras, the same in both processes."""
    from clsplat.cameras_json import read_cameras
    from clsplat.paths_between import interpolate

    cameras = [item.camera for item in read_cameras(model / "cameras.json")]
    return interpolate(cameras[:: max(len(cameras) // KEYS, 1)][:KEYS], FRAMES)


def serve(model: Path, device: str | None) -> None:
    """The viewer, with the number of its pose in each picture; ends with its input."""
    from clsplat_cli.models import load_model
    from clsplat_cli.view import Viewing, known_cameras

    from clsplat.device import open_device
    from clsplat.tuning import schedule_for

    places = np.array([camera.position for camera in path_of(model)])
    loaded = load_model(model)
    viewing = Viewing(loaded, None, known_cameras(loaded, None, None, None), (0.0, 0.0, 0.0), "127.0.0.1", 0, None,
                      device)
    make = viewing.source.picture

    def stamped(camera: Any, settings: Any) -> Any:
        picture = make(camera, settings)
        number = int(np.argmin(np.linalg.norm(places - camera.position, axis=1)))
        for bit in range(BITS):
            picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)] = 255 * (number >> bit & 1)
        return picture

    viewing.source.picture = stamped  # type: ignore[method-assign]
    threading.Thread(target=viewing.run, daemon=True).start()
    opened = open_device(device)
    print(json.dumps({"port": viewing.server.port, "splats": viewing.source.n_splats,
                      **common.environment(opened, schedule_for(opened))}), flush=True)
    sys.stdin.read()


def number_of(picture: Any) -> int:
    """The number that a picture carries; -1 where it is too narrow for one."""
    if picture.shape[1] < BITS * BLOCK:
        return -1
    bits = [picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)].mean() > 127 for bit in range(BITS)]
    return sum(int(bit) << place for place, bit in enumerate(bits))


class Walker:
    """A client that notes when which picture came.

    Attributes
    ----------
    sent : [s] by pose. seen : (time [s], pose, width, height, bytes) of each picture.
    """

    def __init__(self, port: int, cameras: list[Any], width: int, height: int) -> None:
        from viewer_client import Client

        self.client, self.cameras, self.size = Client(port), cameras, (width, height)
        self.sent: dict[int, float] = {}
        self.seen: list[tuple[float, int, int, int, int]] = []
        self._done = False
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def close(self) -> None:
        self._done = True
        self._reader.join()
        self.client.close()

    def pose(self, number: int) -> None:
        """Tell of a camera of the path."""
        from scipy.spatial.transform import Rotation

        camera = self.cameras[number]
        x, y, z, w = Rotation.from_matrix(camera.rotation.T).as_quat()
        fov = 2.0 * np.arctan(0.5 * camera.height / camera.fy)
        self.sent[number] = time.perf_counter()
        self.client.look(camera.position.tolist(), (w, x, y, z), float(fov), *self.size)

    def wait_for(self, number: int, full: bool, timeout: float = 60.0) -> float:
        """When a picture of this pose came, of full size if wanted."""
        end = time.perf_counter() + timeout
        while time.perf_counter() < end:
            for moment, shown, width, height, _ in self.seen[-4:]:
                if shown >= number and (not full or max(width, height) == min(max(self.size), 1280)):
                    return moment
            time.sleep(0.001)
        raise RuntimeError(f"no picture of pose {number}")

    def _read(self) -> None:
        from viewer_client import decoded

        while not self._done:
            self.client.receive(0.05)
            for data in self.client.pictures:
                picture = decoded(data)
                height, width = picture.shape[:2]
                self.seen.append((time.perf_counter(), number_of(picture), width, height, len(data)))
            self.client.pictures.clear()
            self.client.received.clear()


def walk(scene: str, model: Path, window: str, args: argparse.Namespace) -> None:
    """One model in one window; appends its line."""
    width, height = (int(side) for side in window.split("x"))
    device = ["--device", args.device] if args.device else []
    server = subprocess.Popen([sys.executable, __file__, "--serve", str(model), *device], stdin=subprocess.PIPE,
                              stdout=subprocess.PIPE, text=True)
    assert server.stdin is not None
    assert server.stdout is not None
    told = json.loads(server.stdout.readline())
    walker = Walker(told.pop("port"), path_of(model), width, height)
    try:
        walker.pose(0)
        walker.wait_for(0, full=True)
        poses = min(int(args.seconds / POSE_SECONDS), FRAMES - 200)
        for number in range(1, 61):  # the size settles
            walker.pose(number)
            time.sleep(POSE_SECONDS)
        walker.wait_for(60, full=True)
        del walker.seen[:]
        start = time.perf_counter()
        for number in range(61, poses + 61):
            walker.pose(number)
            time.sleep(max(start + (number - 60) * POSE_SECONDS - time.perf_counter(), 0.0))
        end = time.perf_counter()
        moving = [item for item in walker.seen if item[0] <= end]
        first, full = [], []
        for number in range(poses + 61, poses + 71):
            walker.wait_for(number - 1, full=True)
            time.sleep(0.3)
            walker.pose(number)
            first.append(walker.wait_for(number, full=False) - walker.sent[number])
            full.append(walker.wait_for(number, full=True) - walker.sent[number])
        latencies = []
        for number in range(61, poses + 61):
            came = next((item[0] for item in walker.seen if item[1] >= number), None)
            latencies += [] if came is None else [came - walker.sent[number]]
    finally:
        walker.close()
        server.stdin.close()
        server.wait(20)
    sides = [item[2] for item in moving]
    row = {"task": "view", "scene": scene, "window": window, **told,
           "fps_moving": len(moving) / (end - start),
           "moving_width_px": [min(sides), statistics.median(sides), max(sides)], "latency_ms": quantiles(latencies),
           "first_after_rest_ms": quantiles(first), "full_after_rest_ms": quantiles(full),
           "fps_still": 1.0 / (statistics.median(full) - REST),
           "bytes_moving": statistics.median(item[4] for item in moving), "bytes_full": walker.seen[-1][4],
           "seconds": end - start}
    common.append(args.out, row)
    print(json.dumps(row), flush=True)


def quantiles(seconds: list[float]) -> dict[str, float]:
    """Median, 95th percentile and most [ms]."""
    at = np.quantile(np.array(seconds) * 1e3, (0.5, 0.95, 1.0))
    return dict(zip(("median", "p95", "max"), np.round(at, 1).tolist(), strict=True))


# --- training --------------------------------------------------------------------------------


def watch_training(scene: str, args: argparse.Namespace) -> None:
    """The same run unwatched, served to nobody, and watched, in turn; appends a line."""
    from clsplat.device import open_device
    from clsplat.tuning import schedule_for

    taken: dict[str, list[tuple[float, float, float]]] = {"unwatched": [], "nobody": [], "watched": []}
    pictures: list[int] = []
    with tempfile.TemporaryDirectory() as scratch:
        for round_ in range(args.rounds):
            for kind, times in taken.items():
                model = Path(scratch) / f"{kind}{round_}"
                start = time.perf_counter()
                loop, processor = run_once(training_command(scene, model, args), kind, pictures)
                times.append((loop, time.perf_counter() - start, processor))
                print(scene, kind, "loop {:.2f} s, command {:.2f} s, processor {:.2f} s".format(*times[-1]), flush=True)
    device = open_device(args.device)
    named = {}
    for place, name in enumerate(("loop", "command", "processor")):
        medians = {kind: statistics.median(run[place] for run in times) for kind, times in taken.items()}
        named[f"{name}_seconds"] = medians
        named[f"{name}_more"] = {kind: value / medians["unwatched"] - 1 for kind, value in medians.items()}
    row = {"task": "train --view", "scene": scene, "iterations": args.iterations, "cap_max": args.cap_max,
           **common.environment(device, schedule_for(device)), **named, "pictures": pictures, "runs": taken}
    common.append(args.out, row)
    print(json.dumps(row), flush=True)


def run_once(command: list[str], kind: str, pictures: list[int]) -> tuple[float, float]:
    """One run; the wall time of its loop, from its first line to its last, and its processor time [s]."""
    extra = [] if kind == "unwatched" else ["--view", "--port", "0"]
    process = subprocess.Popen([*command, *extra], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    marks: list[float] = []
    watcher: Any = None
    for line in process.stderr:
        if (found := re.search(r"127\.0\.0\.1:(\d+)", line)) and kind == "watched":
            watcher = Watcher(int(found[1]))
        if re.match(r"\d+/\d+", line) or "about" in line:
            marks.append(time.perf_counter())
    _, status, usage = os.wait4(process.pid, 0)
    if watcher:
        pictures.append(watcher.close())
    assert status == 0
    return marks[-1] - marks[0], usage.ru_utime + usage.ru_stime


class Watcher:
    """A client whose camera never rests, a pose every 16 ms or so."""

    def __init__(self, port: int) -> None:
        from viewer_client import Client

        self._client, self._done, self._pictures = Client(port), False, 0
        self._thread = threading.Thread(target=self._walk)
        self._thread.start()

    def close(self) -> int:
        """How many pictures it got."""
        self._done = True
        self._thread.join()
        return self._pictures

    def _walk(self) -> None:
        step = 0
        try:
            while not self._done:
                self._client.look((np.sin(step / 50.0), 0.0, -2.0), width=1280, height=720)
                step += 1
                self._client.receive(POSE_SECONDS)
                self._pictures += len(self._client.pictures)
                self._client.pictures.clear()
                self._client.received.clear()
        except Exception as error:  # the run has ended, and its server with it
            print("watcher:", type(error).__name__, file=sys.stderr)


if __name__ == "__main__":
    main()
