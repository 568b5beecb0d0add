"""Systems compared on every training photo of a scene: each photo is held out once.

    python benchmarks/folds.py --cases kitchen:-1:20000:1500 --systems default,3dgs      # a few minutes
    python benchmarks/folds.py --table
    python benchmarks/folds.py --page        # write the table of SYSTEMS.md

A scene of few photos has three or four validation views, and a single one of them decides who is ahead. Here a case is
trained `--folds` times. Fold k holds out the training photos k, k + folds, k + 2 folds, ..., so that the means are over
all photos. Differences are taken photo by photo against the first system of the case, with their standard error. Photos
of one scene are not independent of each other, so the error is a lower bound. No test view is looked at.

A case is scene:resolution:cap:iterations, with the resolution of `load_scene`. A run that is there is skipped.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from common import RESULTS, ROOT, Case, Runs, background_of, environment, groups, parser, table, write_between

from clsplat.comparison.methods import Method, parse_methods
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.training.decisions import decide
from clsplat.training.run import train

KEY = ("scene", "resolution", "cap", "iterations", "system", "seed", "fold", "folds")
PAGE = ROOT / "benchmarks" / "SYSTEMS.md"
MARKS = ("<!-- table of folds.py -->", "<!-- end of the table of folds.py -->")


def hold_out_fold(scene: Scene, fold: int, folds: int) -> Scene:
    """Return the scene without its test views, and with the training views of one fold as test views instead."""
    views = scene.train
    if not 2 <= folds <= len(views):
        raise SystemExit(f"--folds {folds}: {scene.name} has {len(views)} training views; name 2 to {len(views)} folds")
    return replace(scene, views=views, test_names=frozenset(view.name for view in views[fold::folds]))


def run(case: Case, method: Method, seed: int, fold: int, args: Any, runs: Runs) -> None:
    """Do one run, if it is not among `runs`."""
    row = vars(case) | {"system": method.label, "seed": seed, "fold": fold, "folds": args.folds}
    if row in runs:
        return
    scene = hold_out_fold(case.load("test"), fold, args.folds)
    background = background_of(case.scene)
    config = method.config(case.cap, seed, {"iterations": case.iterations, "background": background})
    model = train(scene, decide(scene, config.replace(device=args.device)).config)
    if not model.finished:
        raise SystemExit("stopped; the same command goes on")
    renderer = Renderer(args.device)
    held_out = evaluate(renderer, model.splats, scene.test, background)
    runs.add(
        row
        | {
            "psnr": {name: round(metrics["PSNR"], 3) for name, metrics in held_out.per_view.items()},
            "ssim": round(held_out.ssim, 4),
            "splats": len(model.splats),
            "seconds": round(model.seconds, 1),
        }
        | environment(renderer.device, renderer.schedule)
    )
    print(f"{case} {method.label} fold {fold} seed {seed}: {held_out.psnr:.2f} dB", file=sys.stderr, flush=True)


def by_photo(rows: Sequence[dict[str, Any]]) -> dict[tuple[int, str], float]:
    """Return the PSNR of each held-out photo, by seed and name."""
    return {(row["seed"], name): psnr for row in rows for name, psnr in row["psnr"].items()}


def lead(ours: dict[tuple[int, str], float], others: dict[tuple[int, str], float]) -> tuple[float, float, int]:
    """Return the mean difference of two systems over the photos of both [dB], its standard error, and their number.

    The error is NaN with fewer than two photos.
    """
    differences = [ours[photo] - others[photo] for photo in ours if photo in others]
    n = len(differences)
    error = statistics.stdev(differences) / math.sqrt(n) if n > 1 else math.nan
    return (statistics.fmean(differences) if n else math.nan), error, n


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table: means over the held-out photos, and the difference to the first system of the case."""
    lines = []
    for (scene, resolution, cap, iterations, _), case in groups(rows, *KEY[:4], "folds").items():
        first = by_photo([row for row in case if row["system"] == case[0]["system"]])
        for (system,), same in groups(case, "system").items():
            psnr = by_photo(same)
            mean, error, n = lead(psnr, first)
            size = "" if resolution == -1 else f", 1/{resolution}"
            lines.append(
                (
                    f"`{scene}`{size}, {cap}, {iterations}",
                    system,
                    f"{statistics.fmean(psnr.values()):.2f}",
                    "" if system == case[0]["system"] else f"{mean:+.2f} ± {error:.2f}",
                    f"{statistics.fmean(row['ssim'] for row in same):.4f}",
                    n,
                )
            )
    head = ("scene, splats, iterations", "system", "PSNR", "difference", "SSIM", "photos held out")
    return table(head, lines, right=head[2:])


def main() -> None:
    flags = parser(__doc__, RESULTS / "folds.jsonl", smoke=False, page=PAGE)
    flags.add_argument("--cases", nargs="+", default=["kitchen:-1:20000:1500"])
    flags.add_argument("--systems", default="default,3dgs")
    flags.add_argument("--seeds", nargs="+", type=int, default=[0])
    flags.add_argument("--folds", type=int, default=7)
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *MARKS, page(runs.rows))
        return
    if not args.table:
        for seed in args.seeds:
            for case in map(Case.parse, args.cases):
                for fold in range(args.folds):
                    for method in parse_methods(args.systems):
                        run(case, method, seed, fold, args, runs)
    print(page(runs.rows))


if __name__ == "__main__":
    main()
