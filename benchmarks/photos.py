"""What options for real photos are worth: exposure, antialiasing, random backgrounds; a JSON line a run.

    python benchmarks/photos.py [--device 0:0] [--scenes fox:2 kitchen:-1 sceaux_castle:-1 lego:2]
        [--options "" exposure=true antialiased=true "exposure=true,antialiased=true"] [--shapes gaussian skew-normal]
        [--iterations 1000] [--cap 20000] [--seeds 0]
    python benchmarks/photos.py --table                # print what is there, run nothing
    python benchmarks/photos.py --smoke --scenes NAME:1 --out FILE

SCENE:REDUCTION. Test views (lego: its own, over white) are shown in the size of training and at 1/2 and 1/4 of it;
`PSNR` is that of each, `corrected` that of the first after the affine map of colours nearest to the photo. A run that
is there for this commit, device and schedule is skipped.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import common

from clsplat.splats.color import BLACK

KEY = ("scene", "shape", "options", "seed", "iterations", "cap", "platform", "schedule", "commit")
SHOWN = (1, 2, 4)  # parts of the size
WHITE = {"lego"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox:2", "kitchen:-1", "sceaux_castle:-1", "lego:2"])
    parser.add_argument(
        "--options", nargs="+", default=["", "exposure=true", "antialiased=true", "exposure=true,antialiased=true"]
    )
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal"])
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--cap", type=int, default=20_000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "photos.jsonl")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if args.smoke:
        args.shapes, args.iterations, args.cap = ["gaussian"], 8, 60
    if not args.table:
        for scene in args.scenes:
            for shape in args.shapes:
                for seed in args.seeds:
                    for options in args.options:
                        run(scene, shape, options, seed, args)
    print_table(common.read(args.out))


def run(place: str, shape: str, options: str, seed: int, args: argparse.Namespace) -> None:
    """One run; appends its line."""
    from clsplat.comparison.methods import parse_methods
    from clsplat.device.device import open_device
    from clsplat.rendering.tuning import schedule_for
    from clsplat.scenes.scene import load_scene
    from clsplat.training.trainer import Trainer

    device = open_device(args.device)
    environment = common.environment(device, schedule_for(device))
    name, _, reduction = place.rpartition(":")
    key = {
        "scene": place,
        "shape": shape,
        "options": options,
        "seed": seed,
        "iterations": args.iterations,
        "cap": args.cap,
    } | {k: environment[k] for k in KEY if k in environment}
    if any(all(row[k] == value for k, value in key.items()) for row in common.read(args.out)):
        return
    white = name in WHITE
    background = (1.0, 1.0, 1.0) if white else BLACK
    scene = load_scene(common.data_folder() / name, resolution=int(reduction), background=background)
    (system,) = parse_methods(f"{shape}:{options}" if options else shape)
    trainer = Trainer(
        scene, system.config(args.cap, seed, {"iterations": args.iterations, "background": background}), device=device
    )
    model = trainer.run()
    measured = measure(trainer, model.splats, background)
    common.append(args.out, key | environment | {"splats": len(model.splats), "seconds": model.seconds} | measured)


def measure(trainer: Any, splats: Any, background: tuple[float, ...], smallest: int = 11) -> dict[str, Any]:
    """PSNR of the test views in each size, and colour-corrected; sizes below SSIM's window are passed over."""
    from clsplat.evaluation.evaluate import evaluate
    from clsplat.evaluation.metrics import DEFAULT_PROTOCOL

    psnr = []
    side = min(min(view.image.shape[:2]) for view in trainer.scene.test)
    for part in [part for part in SHOWN if side // part >= smallest]:
        views = [view.resized(view.camera.width // part, view.camera.height // part) for view in trainer.scene.test]
        psnr.append(round(evaluate(trainer.renderer, splats, views, background).psnr, 3))
    corrected = evaluate(
        trainer.renderer, splats, trainer.scene.test, background, replace(DEFAULT_PROTOCOL, corrected=True)
    )
    return {"PSNR": psnr, "corrected": round(corrected.psnr, 3)}


def print_table(rows: list[dict[str, Any]]) -> None:
    """A line for each scene, shape and options: means over the seeds."""
    kinds = dict.fromkeys((row["scene"], row["shape"], row["options"]) for row in rows)
    print(f"{'scene':18}{'shape':14}{'options':36}{'PSNR at 1':>10}{'1/2':>10}{'1/4':>10}{'corrected':>11}{'s':>6}")
    for scene, shape, options in kinds:
        same = [row for row in rows if (row["scene"], row["shape"], row["options"]) == (scene, shape, options)]
        psnr = [statistics.fmean(values) for values in zip(*(row["PSNR"] for row in same), strict=True)]
        corrected, seconds = (statistics.fmean(row[name] for row in same) for name in ("corrected", "seconds"))
        shown = "".join(f"{value:10.2f}" for value in psnr)
        print(f"{scene:18}{shape:14}{options or '-':36}{shown:30}{corrected:11.2f}{seconds:6.0f}")


if __name__ == "__main__":
    main()
