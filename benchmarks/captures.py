"""Captures unlike those that defaults are chosen on: what the default makes of them, and what it made before.

    python benchmarks/captures.py                       # all captures with three seeds: half an hour on two cores
    python benchmarks/captures.py --captures tripod --seeds 0
    python benchmarks/captures.py --page                # write the table of STABILITY.md

The cameras are in the worlds of `clsplat demo` (capture_worlds.py), except for objects over one colour, which are
photos without their transparency: "white" is lego, others name their scene. Some are of blender_scenes.py: put these
scenes beside those of CLSPLAT_DATA. "published" are the rules of 3DGS: the extent by the farthest camera, a black
background, and all points of the scene. "not cut out" are those of today, but objects are not cut out. Runs are
measured on held-out training views.
"""

from __future__ import annotations

import io
import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from capture_worlds import ahead, around, around_a_block, from_above, in_street, in_world, street_ahead, tripod
from common import RESULTS, ROOT, Runs, environment, groups, parser, real_scene, spread, table, write_between
from PIL import Image

from clsplat.evaluation.evaluate import evaluate
from clsplat.files.images import ImageU8
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.colmap import Points
from clsplat.scenes.pose_checks import without_unseen_points
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.split import hold_out
from clsplat.splats.color import BLACK, WHITE, Color
from clsplat.training import random_points
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

KEY = ("capture", "rules", "seed", "iterations", "cap")
RULES = ("published", "not cut out", "now")
PAGE = ROOT / "benchmarks" / "STABILITY.md"
MARKS = ("<!-- table of captures.py -->", "<!-- end of the table of captures.py -->")


def with_wrong_pose(scene: Scene, factor: float = 30.0) -> Scene:
    """Return the scene with one camera far away."""
    wrong = scene.views[9]
    pose = wrong.camera.cam_from_world.copy()
    pose[:3, 3] *= factor
    return replace(
        scene,
        views=[*scene.views[:9], replace(wrong, camera=replace(wrong.camera, cam_from_world=pose)), *scene.views[10:]],
    )


def over(color: Color, photos: int, name: str = "lego", resolution: int = 200, quality: int | None = None) -> Scene:
    """Return some photos of an object over one colour, as files without transparency have them.

    Parameters
    ----------
    name, resolution : as of `real_scene`. quality : of the JPEG files that the photos went through; None for PNG.
    """
    scene = real_scene(name, resolution, background=color)
    views = [View(view.name, view.camera, stored(view.loaded().image, quality)) for view in scene.train]
    return replace(scene, views=views[:: len(views) // photos][:photos], test_names=frozenset(), background=BLACK)


def stored(image: ImageU8, quality: int | None) -> ImageU8:
    """Return an image as it comes out of a JPEG file; the same image for a quality of None."""
    if quality is None:
        return image
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return np.array(Image.open(file))


def without_points(scene: Scene) -> Scene:
    """Return the scene without its points."""
    return replace(scene, points=Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)))


def with_points_behind(scene: Scene) -> Scene:
    """Return the scene with its points behind all cameras."""
    return replace(scene, points=replace(scene.points, xyz=scene.points.xyz * (-1, 1, 1) - (20, 0, 0)))


CAPTURES: dict[str, Callable[[], Scene]] = {
    "around": lambda: in_world(around()),
    "one wrong pose": lambda: with_wrong_pose(in_world(around())),
    "from 10 times as far": lambda: in_world(around(10.0)),
    "from 40 times as far": lambda: in_world(around(40.0)),
    "from 40 times as far, no points": lambda: without_points(in_world(around(40.0))),
    "ahead, 9 photos": lambda: in_world(ahead(3, 3, 0.35)),
    "ahead, 20 photos": lambda: in_world(ahead(5, 4, 0.35)),
    "ahead, 30 near photos": lambda: in_world(ahead(6, 5, 0.08)),
    "tripod": lambda: in_world(tripod()),
    "a street, ahead": lambda: in_street(street_ahead()),
    "a street from above": lambda: in_street(from_above(), lots=14),
    "around a corner": lambda: in_street(around_a_block(0.5), block=True),
    "around a block": lambda: in_street(around_a_block(1.0), block=True),
    "points behind the cameras": lambda: with_points_behind(in_world(ahead(5, 4, 0.35))),
    "white, 9 photos": lambda: over(WHITE, 9),
    "white, 25 photos": lambda: over(WHITE, 25),
}
OBJECTS: dict[str, Callable[[], Scene]] = {
    "lego_full over black, 25 photos": lambda: over(BLACK, 25, "lego_full", 2),
    "plant over white, 25 photos": lambda: over(WHITE, 25, "plant", -1),
    "plant over black, 90 photos": lambda: over(BLACK, 90, "plant", -1),
    "plant over white, 90 JPEG photos": lambda: over(WHITE, 90, "plant", -1, quality=90),
    "wires over white, 25 photos": lambda: over(WHITE, 25, "wires", -1),
    "metals over white, 90 photos": lambda: over(WHITE, 90, "metals", -1),
    "metals over black, 25 photos": lambda: over(BLACK, 25, "metals", -1),
}
CUT_OUT = ("white, 9 photos", "white, 25 photos", *OBJECTS)  # captures of an object, which is cut out now


def published(scene: Scene) -> float:
    """Return the extent of 3DGS."""
    centres = np.array([view.camera.position for view in scene.train])
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def measure(scene: Scene, rules: str, config: TrainConfig) -> dict[str, Any]:
    """Return the result of one run."""
    scene, renderer = hold_out(scene), Renderer(config.device)
    if rules != "published":
        points = without_unseen_points(scene.path, scene.points, scene.cameras)
        config = config if rules == "now" else config.replace(cut_background=False)
        model = train(replace(scene, points=points), config)
    else:
        scene.__dict__["extent"] = published(scene)  # where the cached property keeps its value
        with patch.object(random_points, "together", list), patch.object(random_points, "_SMALLEST_BALL", 1.0):
            model = train(scene, config.replace(background=BLACK, cut_background=False))
    found = evaluate(renderer, model.splats, scene.test, model.config.background)
    trained = evaluate(renderer, model.splats, scene.train, model.config.background)
    return {
        "psnr": round(found.psnr, 3),
        "ssim": round(found.ssim, 4),
        "train_psnr": round(trained.psnr, 3),
        "splats": len(model.splats),
        "seconds": round(model.seconds, 1),
    } | environment(renderer.device, renderer.schedule)


def page(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table: a row for each capture, a column for the rules."""
    lines = []
    for (capture,), runs in groups(rows, "capture").items():
        cells = []
        for rules in RULES:
            same = [row for row in runs if row["rules"] == rules]
            psnr, ssim = [row["psnr"] for row in same], [row["ssim"] for row in same]
            cells.append(f"{statistics.fmean(psnr):.2f}{spread(psnr)}, {statistics.fmean(ssim):.3f}" if same else "")
        lines.append((capture, *cells))
    return table(("capture", *RULES), lines, right=RULES)


def main() -> None:
    flags = parser(__doc__, RESULTS / "captures.jsonl", page=PAGE)
    known = CAPTURES | OBJECTS
    flags.add_argument("--captures", nargs="+", default=list(known), choices=list(known))
    flags.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    flags.add_argument("--iterations", type=int, default=1000)
    flags.add_argument("--cap", type=int, default=6000)
    args = flags.parse_args()
    if args.smoke:
        args.captures, args.seeds, args.iterations, args.cap = ["ahead, 9 photos"], [0], 4, 100
    runs = Runs(args.out, KEY)
    for capture in [] if args.table or args.page else args.captures:
        scene: Scene | None = None
        for seed in args.seeds:
            for rules in RULES:
                row = {"capture": capture, "rules": rules, "seed": seed, "iterations": args.iterations, "cap": args.cap}
                if row in runs or (rules == "not cut out" and capture not in CUT_OUT):
                    continue
                scene = scene or known[capture]()
                options = {"iterations": args.iterations, "cap_max": args.cap, "seed": seed, "device": args.device}
                found = measure(scene, rules, TrainConfig(**options))
                runs.add(row | found)
                print(f"{capture}, {rules}, seed {seed}: {found['psnr']:.2f} dB", file=sys.stderr, flush=True)
    text = page(runs.rows)
    if args.page:
        write_between(PAGE, *MARKS, text)
    print(text)


if __name__ == "__main__":
    main()
