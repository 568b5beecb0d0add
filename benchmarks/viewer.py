"""How fast the viewer is: pictures a second, latency of a picture, and the cost of watching a training run.

    python benchmarks/viewer.py                      # moving and still, on the scenes' models
    python benchmarks/viewer.py --training           # the cost of watching a run

The server is a process of its own. The client walks along a path between training cameras as a browser does: it sends a
pose every 16 ms, whether pictures arrive or not, and decodes what arrives. Each picture carries the number of its pose
in its corner, as blocks that JPEG keeps. The latency is the time from sending a pose to having decoded the first
picture of it or of a later one. After a rest a single pose is sent, and the times of the first and of the full picture
are measured. The full picture waits 150 ms for the camera to rest; without that wait its time gives the possible number
of full pictures a second.

Watching: one run in stretches of iterations, in turn without a viewer, with a client at rest and with a moving client.
A client at rest gets a picture now and then. The time of each stretch is compared with the stretches without a viewer
before and after it.
"""

from __future__ import annotations

import argparse
import json
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

sys.path.extend(common.TEST_HELPERS)

KEYS, FRAMES = 4, 4000  # training cameras on the path, poses between them
POSE_SECONDS = 0.016
REST = 0.15  # seconds, of clsplat/viewer/viewer.py
KINDS = ("unwatched", "resting", "moving")
STRETCH = 25  # iterations
SETTLED = 2  # first rounds of stretches, which do not count: the first visit builds kernels
BITS, BLOCK = 12, 8  # of a pose's number; side of a bit [px]
SCENES = {"fox": 2, "kitchen": -1}  # with their -r


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "viewer.jsonl", table=False, smoke=False)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--models", type=Path, help="folder of trained models by scene; missing models are trained")
    parser.add_argument("--windows", nargs="*", default=["1280x720", "1920x1080"])
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the camera's movement")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap-max", type=int, default=20000)
    parser.add_argument("--training", action="store_true", help="measure the cost of watching a run")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--watch", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(args.serve, args.device)
        return
    if args.watch:
        watch(args.watch)
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
    """Return the `clsplat train` command of a scene."""
    device = ["--device", args.device] if args.device else []
    resolution = ["-r", str(SCENES[scene])] if scene in SCENES else []
    return [
        *common.CLSPLAT,
        "train",
        str(common.data_folder() / scene),
        *resolution,
        "-m",
        str(model),
        "--eval",
        "--iterations",
        str(args.iterations),
        "--cap-max",
        str(args.cap_max),
        *device,
    ]


# --- pictures --------------------------------------------------------------------------------


def path_of(model: Path) -> list[Any]:
    """Return cameras on a path through some training cameras; both processes get the same ones."""
    from clsplat.cameras.cameras_json import read_cameras
    from clsplat.cameras.interpolate import interpolate

    cameras = [item.camera for item in read_cameras(model / "cameras.json")]
    return interpolate(cameras[:: max(len(cameras) // KEYS, 1)][:KEYS], FRAMES)


def serve(model: Path, device: str | None) -> None:
    """Run the viewer with the number of the pose in each picture, until the input ends."""
    from clsplat.device.device import open_device
    from clsplat.models.model import load_model
    from clsplat.rendering.tuning import schedule_for
    from clsplat.viewer.session import ServerOptions, ViewingSession

    places = np.array([camera.position for camera in path_of(model)])
    loaded = load_model(model)
    viewing = ViewingSession(loaded, options=ServerOptions(port=0), device=device)
    make = viewing.source.view

    def stamped(camera: Any, settings: Any) -> Any:
        view = make(camera, settings)
        number = int(np.argmin(np.linalg.norm(places - camera.position, axis=1)))
        for bit in range(BITS):
            view.picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)] = 255 * (number >> bit & 1)
        return view

    viewing.source.view = stamped  # type: ignore[method-assign]
    threading.Thread(target=viewing.run, daemon=True).start()
    opened = open_device(device)
    print(
        json.dumps(
            {
                "port": viewing.server.port,
                "splats": viewing.source.n_splats,
                **common.environment(opened, schedule_for(opened)),
            }
        ),
        flush=True,
    )
    sys.stdin.read()


def number_of(picture: Any) -> int:
    """Return the number that a picture carries; -1 if the picture is too narrow."""
    if picture.shape[1] < BITS * BLOCK:
        return -1
    bits = [picture[:BLOCK, BLOCK * bit : BLOCK * (bit + 1)].mean() > 127 for bit in range(BITS)]
    return sum(int(bit) << place for place, bit in enumerate(bits))


class Walker:
    """A client that records the arrival of pictures.

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
        """Send a camera of the path."""
        from scipy.spatial.transform import Rotation

        camera = self.cameras[number]
        x, y, z, w = Rotation.from_matrix(camera.rotation.T).as_quat()
        fov = 2.0 * np.arctan(0.5 * camera.height / camera.fy)
        self.sent[number] = time.perf_counter()
        self.client.look(camera.position.tolist(), (w, x, y, z), float(fov), *self.size)

    def wait_for(self, number: int, full: bool, timeout: float = 60.0) -> float:
        """Return when a picture of this pose arrived, of full size if `full`."""
        from clsplat.viewer.settings import DEFAULT_SIZE

        end = time.perf_counter() + timeout
        while time.perf_counter() < end:
            for moment, shown, width, height, _ in self.seen[-4:]:
                if shown >= number and (not full or max(width, height) == min(max(self.size), DEFAULT_SIZE)):
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
    """Measure one model in one window and append its line."""
    width, height = (int(side) for side in window.split("x"))
    device = ["--device", args.device] if args.device else []
    server = subprocess.Popen(
        [sys.executable, __file__, "--serve", str(model), *device],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )
    assert server.stdin is not None
    assert server.stdout is not None
    greeting = json.loads(server.stdout.readline())
    walker = Walker(greeting.pop("port"), path_of(model), width, height)
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
    row = {
        "task": "view",
        "scene": scene,
        "window": window,
        **greeting,
        "fps_moving": len(moving) / (end - start),
        "moving_width_px": [min(sides), statistics.median(sides), max(sides)],
        "latency_ms": quantiles(latencies),
        "first_after_rest_ms": quantiles(first),
        "full_after_rest_ms": quantiles(full),
        "fps_still": 1.0 / (statistics.median(full) - REST),
        "bytes_moving": statistics.median(item[4] for item in moving),
        "bytes_full": walker.seen[-1][4],
        "seconds": end - start,
    }
    common.append(args.out, row)
    print(json.dumps(row), flush=True)


def quantiles(seconds: list[float]) -> dict[str, float]:
    """Return the median, the 95th percentile and the maximum [ms]."""
    at = np.quantile(np.array(seconds) * 1e3, (0.5, 0.95, 1.0))
    return dict(zip(("median", "p95", "max"), np.round(at, 1).tolist(), strict=True))


# --- training --------------------------------------------------------------------------------


def watch_training(scene: str, args: argparse.Namespace) -> None:
    """Train in stretches without a viewer, with a client at rest and with a moving client; append the line."""
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.scene import load_scene
    from clsplat.training.config import TrainConfig
    from clsplat.training.run import train
    from clsplat.viewer.initial_view import initial_view
    from clsplat.viewer.server import Server
    from clsplat.viewer.training import TrainingView

    loaded = load_scene(common.data_folder() / scene, resolution=SCENES.get(scene, -1), eval=True)
    config = TrainConfig(iterations=args.iterations, cap_max=args.cap_max, device=args.device)
    view = TrainingView(config)
    server = Server(view.viewer, initial_view(loaded.points.xyz, [item.camera for item in loaded.train]), port=0)
    watcher = subprocess.Popen(
        [sys.executable, __file__, "--watch", str(server.port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )
    assert watcher.stdin is not None
    assert watcher.stdout is not None
    watcher.stdout.readline()  # the client is connected
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    now = ["unwatched", time.perf_counter()]

    def visit(trainer: Any, stop: Any) -> None:
        if now[0] != "unwatched" or trainer.iteration == 1:  # the first visit builds kernels
            view.visit(trainer, stop)
        else:
            view._left = view._clock()  # unwatched time earns no time for pictures
        if trainer.iteration % STRETCH == 0:
            trainer.device.finish()
            seconds[now[0]].append(time.perf_counter() - now[1])
            now[0] = KINDS[trainer.iteration // STRETCH % len(KINDS)]
            watcher.stdin.write(now[0] + "\n")
            watcher.stdin.flush()
            now[1] = time.perf_counter()

    train(loaded, config, visit=visit)
    watcher.stdin.close()
    pictures = json.loads(watcher.stdout.readline())
    watcher.wait(20)
    server.close()
    rounds = min(map(len, seconds.values()))
    times = np.array([seconds[kind][:rounds] for kind in KINDS])[:, SETTLED:]
    # The unwatched stretches before and after a stretch suffer as much from other work on the machine.
    plain = 0.5 * (times[0, :-1] + times[0, 1:])
    more = {kind: quartiles(times[place, :-1] / plain - 1.0) for place, kind in enumerate(KINDS) if place}
    device = open_device(args.device)
    row = {
        "task": "train --view",
        "scene": scene,
        "iterations": args.iterations,
        "cap_max": args.cap_max,
        **common.environment(device, schedule_for(device)),
        "stretch": STRETCH,
        "stretches": times.shape[1],
        "more_time": more,
        "seconds": {kind: float(times[place].sum()) for place, kind in enumerate(KINDS)},
        "pictures_a_second": {kind: count / sum(seconds[kind]) for kind, count in pictures.items()},
    }
    common.append(args.out, row)
    print(json.dumps(row), flush=True)


def quartiles(values: Any) -> list[float]:
    """Return the lower quartile, the median and the upper quartile."""
    return np.round(np.quantile(values, (0.25, 0.5, 0.75)), 4).tolist()


def watch(port: int) -> None:
    """Run a client that rests or moves as the lines of its input say; print the number of pictures by kind."""
    from viewer_client import Client

    kind = [KINDS[0]]

    def listen() -> None:
        for line in sys.stdin:
            kind[0] = line.strip()
        kind[0] = ""

    counts = dict.fromkeys(KINDS, 0)
    with Client(port) as client:
        client.look((0.0, 0.0, -2.0), width=1280, height=720)
        print("connected", flush=True)
        threading.Thread(target=listen, daemon=True).start()
        step = 0
        while kind[0]:
            if kind[0] == "moving":
                client.look((np.sin(step / 50.0), 0.0, -2.0), width=1280, height=720)
                step += 1
            client.receive(POSE_SECONDS)
            counts[kind[0] or KINDS[0]] += len(client.pictures)
            client.pictures.clear()
            client.received.clear()
    print(json.dumps(counts), flush=True)


if __name__ == "__main__":
    main()
