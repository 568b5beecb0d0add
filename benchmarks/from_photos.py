"""Photographs alone against the same photographs with given poses: quality by both ways, and what reconstruction takes.

    python benchmarks/from_photos.py --work FOLDER [--scenes sceaux_castle kitchen fox_ngp fox_video] [--seeds 0 1 2]
    python benchmarks/from_photos.py --table                 # print what is there, run nothing

The photos are copied into FOLDER without their poses (fox_video: made into a video, whose frames are taken) and
reconstructed there, once; then both scenes train with equal options and seeds. Test views are the same photos by both
ways: every 8th. What is in the results already is not run again.
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
from clsplat.scenes.reconstruct.options import ReconstructOptions
from clsplat.scenes.reconstruct.reconstruct import reconstruct
from clsplat.training.config import TrainConfig

# Name to the scene with poses and the reduction at which both ways are trained.
SCENES = {
    "sceaux_castle": ("sceaux_castle", 1),
    "kitchen": ("kitchen", 1),
    "fox_ngp": ("fox/ngp", 2),
    "fox_video": ("fox", 2),
}
WAYS = ("given poses", "photos alone")
FPS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--camera-model", default=ReconstructOptions().camera_model)
    parser.add_argument("--work", type=Path, help="keep photos and reconstructed scenes here")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "from_photos.jsonl")
    parser.add_argument("--table", action="store_true")
    args = parser.parse_args()
    if not args.table:
        if args.work is None:
            parser.error("give --work")
        for scene in args.scenes:
            measure(scene, args)
    print_table(common.read(args.out))


def measure(scene: str, args: argparse.Namespace) -> None:
    """Reconstruct once, train by both ways with each seed."""
    given, resolution = SCENES[scene]
    key = {"scene": scene, "iterations": args.iterations, "cap": args.cap, "camera_model": args.camera_model}
    jobs = [key | {"way": way, "seed": seed} for seed in args.seeds for way in WAYS]
    done = common.read(args.out)
    jobs = [job for job in jobs if not any(all(row[k] == v for k, v in job.items()) for row in done)]
    if not jobs:
        return
    path = common.data_folder() / given
    made = args.work / f"{scene}-{args.camera_model}"
    figures = made.with_suffix(".jsonl")
    if not figures.exists():
        photos = _photos(scene, path, args.work)
        options = ReconstructOptions(camera_model=args.camera_model, frames=_count(path))
        result = reconstruct(photos, made, options, overwrite=True)
        common.append(figures, {k: v for k, v in asdict(result).items() if k != "scene"})
    device = open_device(None)
    schedule = schedule_for(device)
    for job in jobs:
        posed = clsplat.load_scene(path, resolution=resolution)
        if job["way"] != WAYS[0]:
            held_out = _same_photos(posed, made, args.work)
            posed = clsplat.load_scene(made, resolution=resolution, test_list=held_out)
        config = TrainConfig(
            iterations=args.iterations, cap_max=args.cap, seed=job["seed"], test_iterations=(args.iterations,)
        )
        model = clsplat.train(posed, config)
        last = model.evaluations[args.iterations]
        row = job | {
            "psnr": last.psnr,
            "ssim": last.ssim,
            "splats": len(model.splats),
            "seconds": model.seconds,
            "per_view": {Path(name).name: values["PSNR"] for name, values in last.per_view.items()},
            "points": len(posed.points),
            "views": len(posed.views),
        }
        if job["way"] != WAYS[0]:
            row["reconstruction"] = common.read(figures)[-1]
        common.append(args.out, row | common.environment(device, schedule))
        print(job, f"{last.psnr:.2f} dB", flush=True)


def _names(path: Path) -> list[str]:
    """File names of the photos that have given poses, sorted."""
    return [Path(name).name for name in clsplat.load_scene(path, resolution=32, eval=False).names]


def _count(path: Path) -> int:
    return len(_names(path))


def _photos(scene: str, path: Path, work: Path) -> Path:
    """The photos alone, or a video of them."""
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


def _same_photos(given: Any, made: Path, work: Path) -> Path:
    """A list of the reconstructed scene's views that are the given one's test views."""
    names = sorted(Path(name).name for name in given.names)
    order = {name: number for number, name in enumerate(names)}
    views = clsplat.load_scene(made, resolution=32, eval=False).names
    held_out = {order[Path(name).name] for name in given.test_names}
    chosen = [name for name in views if (int(name[6:11]) if name.startswith("frame_") else order[name]) in held_out]
    file = work / f"{made.name}-test.txt"
    file.write_text("\n".join(chosen))
    return file


def print_table(rows: list[dict[str, Any]]) -> None:
    """A line for each scene and lens model: means over the seeds that both ways have."""
    print(
        "| photographs | lens model | placed | seconds | off px | track | points | given poses | photos alone | "
        "difference | seeds |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    kinds = sorted({(row["scene"], row["camera_model"], row["iterations"], row["cap"]) for row in rows})
    for kind in kinds:
        of = [row for row in rows if (row["scene"], row["camera_model"], row["iterations"], row["cap"]) == kind]
        by = {way: {row["seed"]: row for row in of if row["way"] == way} for way in WAYS}
        seeds = sorted(set(by[WAYS[0]]) & set(by[WAYS[1]]))
        if not seeds:
            continue
        given, alone = (statistics.mean(by[way][seed]["psnr"] for seed in seeds) for way in WAYS)
        r = by[WAYS[1]][seeds[0]]["reconstruction"]
        print(
            f"| {kind[0]} | {kind[1]} | {r['registered']}/{r['photos']} | {r['seconds']:.0f} | {r['error']:.2f} | "
            f"{r['track_length']:.1f} | {r['points']} | {given:.2f} dB | {alone:.2f} dB | {alone - given:+.2f} dB | "
            f"{len(seeds)} |"
        )


if __name__ == "__main__":
    main()
