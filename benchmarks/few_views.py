"""Runs with 3 to 18 photos of real scenes: what the default does to learn the scene and not each photo.

    python benchmarks/few_views.py --cases fox:4:20000:2000:6 --systems default,default:dropout=0,3dgs
    python benchmarks/few_views.py --cases fox:2:100000:7000:6 --views test      # once, after the choice
    python benchmarks/few_views.py --page      # write the tables of SYSTEMS.md

A case is scene:resolution:cap:iterations:photos. The photos are training views at equal steps along the sorted names,
with the first and the last one. Points of a COLMAP scene are those that at least two of these photos show, as if they
alone had been reconstructed with these poses. Validation views are the training views that were left out.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from common import RESULTS, ROOT, Case, Runs, background_of, environment, groups, parser, spread, table, write_between

from clsplat.comparison.methods import Method, parse_methods
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.few_photos import few_photos
from clsplat.scenes.scene import Scene
from clsplat.training.decisions import decide
from clsplat.training.run import train

KEY = ("scene", "resolution", "cap", "iterations", "photos", "system", "seed", "views")
MEASURED = 20  # validation views that are measured, at most
STEEP = "default:depth_smoothness=0"
UNCHECKED = "default:depth_smoothness=0,occluder_check=false"
BEFORE = "default:depth_smoothness=0,dropout=0,random_points=0.05,occluder_check=false"  # as with many photos
ON_PAGE = ("default", STEEP, UNCHECKED, BEFORE, "3dgs")  # systems of the page, in its order; --table has all
PAGE = ROOT / "benchmarks" / "SYSTEMS.md"
MARKS = ("<!-- table of few_views.py -->", "<!-- end of the table of few_views.py -->")


@dataclass(frozen=True)
class FewPhotosCase(Case):
    """A case of some photos of a scene: scene:resolution:cap:iterations:photos."""

    photos: int

    def load(self, views: str) -> Scene:
        """Return the scene with few training views and its test views; the other training views validate."""
        whole = super().load("test")
        few = few_photos(whole, self.photos)
        others = frozenset(view.name for view in whole.train) - frozenset(view.name for view in few.train)
        return replace(whole, points=few.points, validation_names=others)


def run(case: FewPhotosCase, method: Method, seed: int, args: Any, runs: Runs) -> None:
    """Do one run, if it is not among `runs`."""
    row: dict[str, Any] = vars(case) | {"system": method.label, "seed": seed, "views": args.views}
    if row in runs:
        return
    scene, background = case.load(args.views), background_of(case.scene)
    config = method.config(case.cap, seed, {"iterations": case.iterations, "background": background})
    decision = decide(scene, config.replace(device=args.device))
    model = train(scene, decision.config)
    renderer = Renderer(args.device)
    views = scene.test if args.views == "test" else scene.validation[:: -(-len(scene.validation) // MEASURED)]
    found = evaluate(renderer, model.splats, views, background)
    runs.add(
        row
        | {
            "psnr": round(found.psnr, 3),
            "ssim": round(found.ssim, 4),
            "train_psnr": round(evaluate(renderer, model.splats, scene.train, background).psnr, 3),
            "points": len(scene.points),
            "splats": len(model.splats),
            "seconds": round(model.seconds, 1),
            "decided": list(decision.reasons),
        }
        | environment(renderer.device, renderer.schedule)
    )
    print(f"{case} {method.label} seed {seed}: {found.psnr:.2f} dB, SSIM {found.ssim:.4f}", file=sys.stderr)


def page(rows: list[dict[str, Any]], systems: Sequence[str] = ON_PAGE) -> str:
    """Return a Markdown table of some systems: a row for each case that several have, a column for each."""
    rows = sorted((row for row in rows if row["system"] in systems), key=lambda row: row["views"] == "test")
    lines = []
    for (scene, resolution, photos, cap, iterations, views), case in groups(
        rows, "scene", "resolution", "photos", "cap", "iterations", "views"
    ).items():
        if len({row["system"] for row in case}) < 2:
            continue
        cells = []
        for system in systems:
            same = [row for row in case if row["system"] == system]
            psnr, ssim = [row["psnr"] for row in same], [row["ssim"] for row in same]
            cells.append(f"{statistics.fmean(psnr):.2f}{spread(psnr)}, {statistics.fmean(ssim):.3f}" if same else "")
        size = "" if resolution == -1 else f" `-r {resolution}`"
        lines.append((f"`{scene}`{size}", photos, cap, iterations, views, *cells))
    head = ("scene", "photos", "splats", "iterations", "views", *systems)
    return table(head, lines, right=(*head[1:4], *systems))


def main() -> None:
    flags = parser(__doc__, RESULTS / "few_views.jsonl", smoke=False, page=PAGE)
    flags.add_argument("--cases", nargs="+", default=["fox:4:20000:2000:6"])
    flags.add_argument("--systems", default="default,default:dropout=0")
    flags.add_argument("--seeds", nargs="+", type=int, default=[0])
    flags.add_argument("--views", choices=("validation", "test"), default="validation")
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *MARKS, page(runs.rows))
        return
    if not args.table:
        for case in map(FewPhotosCase.parse, args.cases):
            for method in parse_methods(args.systems):
                for seed in args.seeds:
                    run(case, method, seed, args, runs)
    print(page(runs.rows, list(dict.fromkeys(row["system"] for row in runs.rows))))


if __name__ == "__main__":
    main()
