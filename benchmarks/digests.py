"""Checks that renders, gradients and trained models keep their bits while the code is rearranged.

    python benchmarks/digests.py                # compute all digests and compare them with the committed ones
    python benchmarks/digests.py --write        # store the digests of this device and driver
    python benchmarks/digests.py --schedules cpu16 --cases gaussian exposure      # only these

A case is a short training run. Its digests are SHA-256 sums of the trained splats, of a render (colour, alpha, depth)
and of the gradients of that render. `benchmarks/results/digests.json` holds them for each device, driver and schedule;
other devices, drivers and processors round differently, so the script says when it has no digests to compare with.
A deliberate change of the arithmetic needs `--write` and a reason in the commit message.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

FILE = Path(__file__).resolve().parent / "results" / "digests.json"
SHAPES = (
    "gaussian",
    "skew-normal",
    "skew-normal-direct",
    "half-gaussian",
    "bisected-skew",
    "generalised-exponential",
    "ges-modulation",
    "student-t",
)
# Options that reach code which a plain run does not reach; on the first schedule only.
OPTIONS: dict[str, dict[str, Any]] = {
    "mcmc": {"strategy": "mcmc"},
    "mcmc-two-sided": {"strategy": "mcmc", "shape": "bisected-skew"},
    "length-squared": {"strategy": "mcmc", "relocation": "length-squared", "shape": "student-t"},
    "opacity-only": {"strategy": "mcmc", "relocation": "opacity-only"},
    "exposure": {"exposure": True},
    "random-background": {"random_background": True, "random_background_until": 1.0},
    "antialiased": {"antialiased": True},
    "antialiased-direct": {"antialiased": True, "shape": "skew-normal-direct"},
    "pixel": {"antialiased": True, "low_pass": 0.1},
    "visible-adam": {"visible_adam": True},
    "sghmc": {"position_optimizer": "sghmc"},
    "sghmc-sss": {"position_optimizer": "sghmc-sss", "shape": "student-t"},
    "alternation": {"alternation": "cyclic", "alternation_cycle": 10},
    "polar": {"shape": "skew-normal-direct", "skew_map": "polar"},
    "coupled": {"shape": "bisected-skew", "skew_map": "coupled"},
    "pdf": {"normalisation": "pdf"},
    "none": {"normalisation": "none"},
    "regularisers": {"opacity_reg": 0.01, "scale_reg": 0.01, "bisect_reg": 0.01, "shape": "bisected-skew"},
    "depth-criterion": {"depth_threshold": 1e-6, "opacity_reset": 2},
    "numpy": {"optimizer": "numpy"},
    "coarse": {"coarse_to_fine": True},
}
SCHEDULES = ("cpu16", "cpu8", "scalar")
COMMON = {
    "iterations": 50,
    "cap_max": 400,
    "densify_interval": 5,
    "sh_interval": 8,
    "init": "random",
    "seed": 3,
    "coarse_to_fine": False,
    "antialiased": False,
    "low_pass": 0.3,
}
WIDTH, HEIGHT, VIEWS = 72, 56, 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--schedules", nargs="+", default=SCHEDULES)
    parser.add_argument("--cases", nargs="+", default=[*SHAPES, *OPTIONS])
    parser.add_argument("--device")
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(digests(args.cases, args.device, Path(args.child))))
        return
    stored = json.loads(args.file.read_text(encoding="utf-8")) if args.file.exists() else {}
    differences = 0
    with tempfile.TemporaryDirectory() as folder:
        write_scene(Path(folder))
        for schedule in args.schedules:
            cases = [name for name in args.cases if name in SHAPES or schedule == SCHEDULES[0]]
            computed = in_child(schedule, cases, args.device, folder)
            key = f"{computed['device']} {schedule}"
            if args.write:
                stored.setdefault(key, {}).update(computed["digests"])
            elif key not in stored:
                print(f"{key}: no digests stored; run with --write on the commit to compare with")
                differences += 1
            else:
                differences += compare(key, computed["digests"], stored[key])
    if args.write:
        args.file.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    sys.exit(1 if differences else 0)


def in_child(schedule: str, cases: list[str], device: str | None, folder: str) -> dict[str, Any]:
    """The digests of a process whose schedule is fixed."""
    command = [sys.executable, __file__, "--child", folder, "--cases", *cases]
    command += ["--device", device] if device else []
    environment = os.environ | {"CLSPLAT_SCHEDULE": schedule}
    result = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True, encoding="utf-8")
    computed: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return computed


def compare(key: str, computed: dict[str, dict[str, str]], stored: dict[str, dict[str, str]]) -> int:
    """Print each digest that differs; the number of these."""
    differences = 0
    for case, parts in computed.items():
        for part, digest in parts.items():
            if stored.get(case, {}).get(part) != digest:
                print(f"{key}: {case}: {part} differs")
                differences += 1
    print(f"{key}: {len(computed)} cases, {differences} differences")
    return differences


def digests(cases: list[str], device_name: str | None, folder: Path) -> dict[str, Any]:
    """The device's name, and {case: {"model" | "render" | "gradients": digest}}."""
    import clsplat

    scene = clsplat.load_scene(folder)
    renderer = clsplat.Renderer(device_name)
    info, found = renderer.device.info, {}
    weights = np.random.default_rng(7).normal(size=(HEIGHT, WIDTH, 3))
    for case in cases:
        options = {"shape": case} if case in SHAPES else OPTIONS[case]
        config = clsplat.TrainConfig.from_json(COMMON | options | {"device": device_name})
        splats = clsplat.train(scene, config).splats
        image = renderer.render(splats, scene.train[1].camera, (0.1, 0.2, 0.3))
        images = {"color": image.color, "alpha": image.alpha, "depth": image.depth}
        gradients = renderer.backward(weights, weights[..., 0])
        parts = {"model": splats.to_numpy(), "render": images, "gradients": gradients}
        found[case] = {part: digest(arrays) for part, arrays in parts.items()}
    # PoCL's name of a CPU also has the instruction set, which decides how kernels round.
    return {"device": f"{info.platform} {info.driver} {info.name}", "digests": found}


def digest(arrays: Any) -> str:
    """The first 16 digits of the SHA-256 sum of all arrays, in the order of their names."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()[:16]


def write_scene(folder: Path) -> None:
    """Six transparent photos of coloured discs, from cameras on an arc, as a transforms.json scene."""
    from PIL import Image

    rng = np.random.default_rng(11)
    discs = [(rng.uniform(-1, 1, 3), rng.uniform(0.1, 0.5), rng.integers(0, 256, 3)) for _ in range(24)]
    focal, frames = 80.0, []
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for view in range(VIEWS):
        angle = 0.35 * (view - VIEWS / 2)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3], world_from_camera[:3, 3] = turn, turn @ [0, 0, 5.0]
        image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        placed = [(turn.T @ centre - [0, 0, 5.0], radius, colour) for centre, radius, colour in discs]
        for (x, y, z), radius, colour in sorted(placed, key=lambda disc: disc[0][2]):
            u, v = WIDTH / 2 - focal * x / z, HEIGHT / 2 + focal * y / z
            inside = (columns - u) ** 2 + (rows - v) ** 2 < (focal * radius / z) ** 2
            image[inside] = [*colour, 255]
        name = f"view_{view}.png"
        Image.fromarray(image).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": world_from_camera.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": focal, "fl_y": focal, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}), encoding="utf-8")


if __name__ == "__main__":
    main()
