"""Photographs alone against the same photographs with known poses: quality of both, and the cost of reconstruction.

    python benchmarks/from_photos.py --work FOLDER [--scenes sceaux_castle kitchen fox_ngp fox_video] [--seeds 0 1 2]
    python benchmarks/from_photos.py --table                 # print the finished runs, run nothing

The photos are copied into FOLDER without their poses and reconstructed there, once. fox_video is first made into a
video, whose frames are used. Then both scenes train with equal options and seeds. Test views are the same photos in
both: every 8th. A finished run is not repeated.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any

import common

import clsplat
from clsplat.device.device import open_device
from clsplat.files.images import read_image
from clsplat.files.video import VideoWriter
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.reconstruct.reconstruct import ReconstructOptions, reconstruct
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig

# Names, each with the scene with poses and the reduction at which both scenes are trained.
SCENES = {
    "sceaux_castle": ("sceaux_castle", 1),
    "kitchen": ("kitchen", 1),
    "fox_ngp": ("fox/ngp", 2),
    "fox_video": ("fox", 2),
}
WAYS = ("given poses", "photos alone")
FPS = 10
CASE = ("scene", "camera_model", "iterations", "cap")
KEY = (*CASE, "way", "seed")


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "from_photos.jsonl", device=False, smoke=False)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--camera-model", default=ReconstructOptions().camera_model)
    parser.add_argument("--work", type=Path, help="folder of the photos and the reconstructed scenes")
    args = parser.parse_args()
    runs = common.Runs(args.out, KEY)
    if not args.table:
        if args.work is None:
            parser.error("give --work")
        for name in args.scenes:
            measure(runs, name, args)
    print_table(runs.rows)


def measure(runs: common.Runs, name: str, args: argparse.Namespace) -> None:
    """Reconstruct a scene once, and train both scenes with each seed."""
    source, resolution = SCENES[name]
    case = {"scene": name, "iterations": args.iterations, "cap": args.cap, "camera_model": args.camera_model}
    cases = [case | {"way": way, "seed": seed} for seed in args.seeds for way in WAYS]
    cases = [case for case in cases if case not in runs]
    if not cases:
        return
    path = common.data_folder() / source
    made = args.work / f"{name}-{args.camera_model}"
    report = made.with_suffix(".jsonl")
    if not report.exists():
        photos = _photos(name, path, args.work)
        options = ReconstructOptions(camera_model=args.camera_model, frames=_count(path))
        result = reconstruct(photos, made, options, overwrite=True)
        common.append(report, {k: v for k, v in asdict(result).items() if k != "scene"})
    device = open_device(None)
    environment = common.environment(device, schedule_for(device))
    for case in cases:
        scene = clsplat.load_scene(path, resolution=resolution)
        if case["way"] != WAYS[0]:
            held_out = _same_photos(scene, made, args.work)
            scene = clsplat.load_scene(made, resolution=resolution, test_list=held_out)
        config = TrainConfig(
            iterations=args.iterations, cap_max=args.cap, seed=case["seed"], test_iterations=(args.iterations,)
        )
        model = clsplat.train(scene, config)
        last = model.evaluations[args.iterations]
        row = case | {
            "psnr": last.psnr,
            "ssim": last.ssim,
            "splats": len(model.splats),
            "seconds": model.seconds,
            "per_view": {Path(view).name: values["PSNR"] for view, values in last.per_view.items()},
            "points": len(scene.points),
            "views": len(scene.views),
        }
        if case["way"] != WAYS[0]:
            row["reconstruction"] = common.read(report)[-1]
        runs.add(row | environment)
        print(case, f"{last.psnr:.2f} dB", flush=True)


def _names(path: Path) -> list[str]:
    """Return the file names of the photos with known poses, sorted."""
    return [Path(name).name for name in clsplat.load_scene(path, resolution=32, eval=False).names]


def _count(path: Path) -> int:
    """Return the number of photos with known poses."""
    return len(_names(path))


def _photos(scene: str, path: Path, work: Path) -> Path:
    """Return a folder of the photos without poses, or a video of them."""
    files = [path / "images" / name for name in _names(path)]
    if scene.endswith("video"):
        video = work / f"{scene}.mp4"
        with VideoWriter(video, FPS) as writer:
            for file in files:
                writer.write(read_image(file))
        return video
    folder = work / scene
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        shutil.copyfile(file, folder / file.name)
    return folder


def _same_photos(posed: Scene, made: Path, work: Path) -> Path:
    """Return a file that lists the views of the reconstructed scene that are test views of the posed one."""
    names = sorted(Path(name).name for name in posed.names)
    order = {name: number for number, name in enumerate(names)}
    views = clsplat.load_scene(made, resolution=32, eval=False).names
    held_out = {order[Path(name).name] for name in posed.test_names}
    chosen = [name for name in views if (int(name[6:11]) if name.startswith("frame_") else order[name]) in held_out]
    file = work / f"{made.name}-test.txt"
    file.write_text("\n".join(chosen), encoding="utf-8")
    return file


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each scene and lens model: means over the seeds that both ways have."""
    head = ["photographs", "lens model", "placed", "seconds", "off px", "track", "points", *WAYS, "difference", "seeds"]
    lines = []
    for (scene, model, _, _), members in sorted(common.groups(rows, *CASE).items()):
        by_seed = {way: {row["seed"]: row for row in members if row["way"] == way} for way in WAYS}
        seeds = sorted(set(by_seed[WAYS[0]]) & set(by_seed[WAYS[1]]))
        if not seeds:
            continue
        known, alone = (statistics.mean(by_seed[way][seed]["psnr"] for seed in seeds) for way in WAYS)
        report = by_seed[WAYS[1]][seeds[0]]["reconstruction"]
        line = [scene, model, f"{report['registered']}/{report['photos']}", f"{report['seconds']:.0f}"]
        line += [f"{report['error']:.2f}", f"{report['track_length']:.1f}", report["points"]]
        lines.append([*line, f"{known:.2f} dB", f"{alone:.2f} dB", f"{alone - known:+.2f} dB", len(seeds)])
    print(common.table(head, lines))


if __name__ == "__main__":
    main()
