"""Exposures of transparent photos: photos of one object, every second one darkened; a JSON line a run.

    python benchmarks/exposures.py [--device 0:0] [--scenes lego_full:8] [--photos 40] [--ratio 0.6]
        [--iterations 800] [--cap 2000] [--seeds 0 1 2] [--backgrounds black grey white] [--random false true]
    python benchmarks/exposures.py --table             # print the finished runs, run nothing
    python benchmarks/exposures.py --smoke --scenes NAME:1 --out FILE

Scenes are SCENE:REDUCTION. A darkened photo has the ratio times the colours of the object. Its background stays as it
is. `found` is the mean brightness of a grey surface with the exposures of the darkened photos, divided by that with the
exposures of the others. It should be the ratio. `corrected` is the PSNR of the test views after the affine map of
colours that is nearest to the photo, without fully transparent pixels. A finished run of this commit, device and
schedule is skipped.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from dataclasses import replace
from typing import Any

import common
import numpy as np

from clsplat.device.device import open_device
from clsplat.evaluation.evaluate import evaluate
from clsplat.evaluation.metrics import DEFAULT_PROTOCOL
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.splats.color import BLACK, WHITE, Color
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer

KEY = (
    *("scene", "photos", "ratio", "background", "random_background", "seed", "iterations", "cap"),
    *("platform", "schedule", "commit"),
)
BACKGROUNDS: dict[str, Color] = {"black": BLACK, "grey": (0.5, 0.5, 0.5), "white": WHITE}
DARKENED = 2  # every second photo
GREY = 0.4  # the colour in which exposures are compared


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "exposures.jsonl")
    parser.add_argument("--scenes", nargs="+", default=["lego_full:8"])
    parser.add_argument("--photos", type=int, default=40, help="number of training photos, evenly among all")
    parser.add_argument("--ratio", type=float, default=0.6, help="brightness of every second photo")
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--cap", type=int, default=2000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--backgrounds", nargs="+", choices=tuple(BACKGROUNDS), default=list(BACKGROUNDS))
    parser.add_argument("--random", nargs="+", choices=("false", "true"), default=["false", "true"])
    args = parser.parse_args()
    if args.smoke:
        args.photos, args.iterations, args.cap, args.seeds = 4, 8, 60, [0]
    runs = common.Runs(args.out, KEY)
    if not args.table:
        for case in itertools.product(args.scenes, args.backgrounds, args.random, args.seeds):
            train(runs, *case, args)
    print_table(runs.rows)


def train(runs: common.Runs, place: str, background: str, random: str, seed: int, args: argparse.Namespace) -> None:
    """Train once and append the line, unless the run is finished."""
    device = open_device(args.device)
    case = {
        "scene": place,
        "photos": args.photos,
        "ratio": args.ratio,
        "background": background,
        "random_background": random == "true",
        "seed": seed,
        "iterations": args.iterations,
        "cap": args.cap,
        **common.environment(device, schedule_for(device)),
    }
    if case in runs:
        return
    color = BACKGROUNDS[background]
    name, _, reduction = place.rpartition(":")
    scene = load_scene(common.data_folder() / name, resolution=int(reduction), background=color)
    scene, darkened = some_darkened(scene, args.photos, args.ratio)
    config = TrainConfig(
        iterations=args.iterations,
        cap_max=args.cap,
        seed=seed,
        background=color,
        exposure=True,
        random_background=random == "true",
    )
    trainer = Trainer(scene, config, device=device)
    model = trainer.run()
    exposures = trainer.exposure.exposures()
    shown = (exposures[:, :, :3].sum(axis=2) * GREY + exposures[:, :, 3]).mean(axis=1)  # (photos,)
    found = float(shown[darkened].mean() / shown[~darkened].mean())
    views = [without_background(view) for view in scene.test]
    corrected = evaluate(trainer.renderer, model.splats, views, color, replace(DEFAULT_PROTOCOL, corrected=True))
    runs.add(case | {"found": round(found, 4), "corrected": round(corrected.psnr, 3), "seconds": model.seconds})


def some_darkened(scene: Scene, number: int, ratio: float) -> tuple[Scene, np.ndarray]:
    """Return the scene with some of its training photos, and which of them are darkened, (number,)."""
    chosen = [scene.train[i] for i in np.linspace(0, len(scene.train) - 1, number).round().astype(int)]
    is_dark = np.arange(number) % DARKENED == DARKENED - 1
    photos = [
        darker(view, ratio, scene.background) if dark else view for view, dark in zip(chosen, is_dark, strict=True)
    ]
    views = sorted([*photos, *scene.test], key=lambda view: view.name)
    darkened = {view.name for view, dark in zip(chosen, is_dark, strict=True) if dark}
    scene = replace(scene, views=views)
    return scene, np.array([view.name in darkened for view in scene.train])


def darker(view: View, ratio: float, background: Color) -> View:
    """Return the view with the ratio times the colours of its object."""
    view = view.loaded()
    if view.alpha is None:
        raise SystemExit(f"{view.name}: is not transparent: give a scene with transparent photos")
    behind = 255.0 * (1.0 - view.alpha[..., None] / 255.0) * np.asarray(background)
    image = np.clip(np.rint(ratio * (view.image - behind) + behind), 0, 255).astype(np.uint8)
    return replace(view, image=image)


def without_background(view: View) -> View:
    """Return the view with a mask of the pixels that are not fully transparent."""
    view = view.loaded()
    return view if view.alpha is None else replace(view, mask=view.alpha > 0)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print a line for each commit, scene and background: means over the seeds."""
    lines = []
    for (commit, scene, background, random), same in common.groups(
        rows, "commit", "scene", "background", "random_background"
    ).items():
        found, corrected = ([row[name] for row in same] for name in ("found", "corrected"))
        lines.append(
            [
                *(commit, scene, f"random, then {background}" if random else background),
                f"{statistics.fmean(found):.3f}",
                f"{statistics.fmean(corrected):.2f}{common.spread(corrected)}",
                len(same),
            ]
        )
    print(common.table(["commit", "scene", "background", "ratio", "test views", "seeds"], lines))


if __name__ == "__main__":
    main()
