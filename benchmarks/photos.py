"""Effect of the options for real photos: exposure, antialiasing, random backgrounds; a JSON line a run.

    python benchmarks/photos.py [--device 0:0] [--scenes fox:2 kitchen:-1 sceaux_castle:-1 lego:2]
        [--options "" exposure=true antialiased=true "exposure=true,antialiased=true"] [--shapes gaussian skew-normal]
        [--iterations 1000] [--cap 20000] [--seeds 0]
    python benchmarks/photos.py --table                # print the finished runs, run nothing
    python benchmarks/photos.py --smoke --scenes NAME:1 --out FILE

Scenes are SCENE:REDUCTION. Test views (lego: its own, over white) are rendered in the size of training and at 1/2 and
1/4 of it. `PSNR` holds the value of each size. `corrected` is the first one after the affine map of colours that is
nearest to the photo. A finished run of this commit, device and schedule is skipped.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from dataclasses import replace
from typing import Any

import common

from clsplat.splats.color import Color

KEY = ("scene", "shape", "options", "seed", "iterations", "cap", "platform", "schedule", "commit")
REDUCTIONS = (1, 2, 4)  # of the size that test views are rendered in
SSIM_WINDOW = 11  # px: no smaller image is measured


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "photos.jsonl")
    parser.add_argument("--scenes", nargs="+", default=["fox:2", "kitchen:-1", "sceaux_castle:-1", "lego:2"])
    parser.add_argument(
        "--options", nargs="+", default=["", "exposure=true", "antialiased=true", "exposure=true,antialiased=true"]
    )
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    args = parser.parse_args()
    if args.smoke:
        args.shapes, args.iterations, args.cap = ["gaussian"], 8, 60
    runs = common.Runs(args.out, KEY)
    if not args.table:
        for scene, shape, seed, options in itertools.product(args.scenes, args.shapes, args.seeds, args.options):
            train(runs, scene, shape, options, seed, args)
    print_table(runs.rows)


def train(runs: common.Runs, place: str, shape: str, options: str, seed: int, args: argparse.Namespace) -> None:
    """Train once and append the line, unless the run is finished."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.scene import load_scene
    from clsplat.training.trainer import Trainer

    device = open_device(args.device)
    name, _, reduction = place.rpartition(":")
    case = {
        "scene": place,
        "shape": shape,
        "options": options,
        "seed": seed,
        "iterations": args.iterations,
        "cap": args.cap,
        **common.environment(device, schedule_for(device)),
    }
    if case in runs:
        return
    background = common.background_of(name)
    scene = load_scene(common.data_folder() / name, resolution=int(reduction), background=background)
    (method,) = parse_methods(f"{shape}:{options}" if options else shape)
    trainer = Trainer(
        scene, method.config(args.cap, seed, {"iterations": args.iterations, "background": background}), device=device
    )
    model = trainer.run()
    measured = measure(trainer, model.splats, background)
    runs.add(case | {"splats": len(model.splats), "seconds": model.seconds} | measured)


def measure(trainer: Any, splats: Any, background: Color) -> dict[str, Any]:
    """Return the PSNR of the test views in each size, and colour-corrected in the first size."""
    from clsplat.evaluation.evaluate import evaluate
    from clsplat.evaluation.metrics import DEFAULT_PROTOCOL

    psnr = []
    side = min(min(view.image.shape[:2]) for view in trainer.scene.test)
    for part in [part for part in REDUCTIONS if side // part >= SSIM_WINDOW]:
        views = [view.resized(view.camera.width // part, view.camera.height // part) for view in trainer.scene.test]
        psnr.append(round(evaluate(trainer.renderer, splats, views, background).psnr, 3))
    corrected = evaluate(
        trainer.renderer, splats, trainer.scene.test, background, replace(DEFAULT_PROTOCOL, corrected=True)
    )
    return {"PSNR": psnr, "corrected": round(corrected.psnr, 3)}


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each scene, shape and options: means over the seeds."""
    lines = []
    for (scene, shape, options), same in common.groups(rows, "scene", "shape", "options").items():
        psnr = [f"{statistics.fmean(values):.2f}" for values in zip(*(row["PSNR"] for row in same), strict=True)]
        corrected, seconds = (statistics.fmean(row[name] for row in same) for name in ("corrected", "seconds"))
        psnr += [""] * (len(REDUCTIONS) - len(psnr))
        lines.append([scene, shape, options or "-", *psnr, f"{corrected:.2f}", f"{seconds:.0f}"])
    print(common.table(["scene", "shape", "options", "PSNR at 1", "at 1/2", "at 1/4", "corrected", "s"], lines))


if __name__ == "__main__":
    main()
