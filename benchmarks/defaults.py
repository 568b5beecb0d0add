"""The default on whole scenes and validation views: the runs behind what a training run decides by itself.

    python benchmarks/defaults.py --cases lego:-1:30000:1500 fox:2:20000:1000 --systems default,3dgs --seeds 0 1 2
    python benchmarks/defaults.py --cases lego_full:-1:100000:2000 --views test     # once, after the choice
    python benchmarks/defaults.py --table
    python benchmarks/defaults.py --page       # write the tables of SYSTEMS.md

A case is scene:resolution:cap:iterations, with the resolution of `load_scene`. Systems are those of `clsplat compare`,
such as default:strategy=mcmc. Transparent scenes have a white background, as published figures have. Runs are measured
on held-out training views, and with `--views test` on the test views, which nothing is chosen on. A run that is there
is skipped. With `--work DIR` a run saves checkpoints there, and goes on from them after an interruption.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from blender_scenes import NAMES
from common import RESULTS, ROOT, Case, Runs, background_of, environment, groups, parser, spread, table, write_between

from clsplat.comparison.methods import Method, parse_methods
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.run import train

KEY = ("scene", "resolution", "cap", "iterations", "system", "seed", "views")
TRAINING_VIEWS = 20  # training views that are measured, to see how far training and other views are apart
NO_SMALL_IMAGES = ":coarse_to_fine=false"
FULL_SIZE = ("lego_full", "fox", "kitchen_large", "south_building_large")  # scenes, in the order of the page
PAGE = ROOT / "benchmarks" / "SYSTEMS.md"
TABLES = {  # scenes by the marks around their table on the page
    ("<!-- table of defaults.py -->", "<!-- end of the table -->"): FULL_SIZE,
    ("<!-- table of new scenes -->", "<!-- end of the table of new scenes -->"): NAMES,
}


def measure(scene: Scene, config: TrainConfig, folder: Path | None) -> dict[str, Any]:
    """Return the result of one run."""
    resume = folder is not None and (folder / "checkpoint.npz").is_file()
    model = train(scene, config, output=folder, resume=resume)
    if not model.finished:
        raise SystemExit("stopped; the same command goes on")
    renderer = Renderer(config.device)
    held_out = evaluate(renderer, model.splats, scene.test, config.background)
    some = scene.train[:: -(-len(scene.train) // TRAINING_VIEWS)]
    return {
        "psnr": round(held_out.psnr, 3),
        "ssim": round(held_out.ssim, 4),
        "train_psnr": round(evaluate(renderer, model.splats, some, config.background).psnr, 3),
        "splats": len(model.splats),
        "seconds": round(model.seconds, 1),
    }


def changes(config: TrainConfig) -> dict[str, Any]:
    """Return the options that differ from those of `TrainConfig()`."""
    defaults = TrainConfig().to_json()
    return {name: value for name, value in config.to_json().items() if value != defaults[name]}


def run(case: Case, method: Method, seed: int, args: Any, runs: Runs) -> None:
    """Do one run, if it is not among `runs`."""
    row = vars(case) | {"system": method.label, "seed": seed, "views": args.views}
    if row in runs:
        return
    scene = case.load(args.views)
    background = background_of(case.scene)
    config = method.config(case.cap, seed, {"iterations": case.iterations, "background": background})
    decision = decide(scene, config.replace(device=args.device))
    folder = None if args.work is None else args.work / "-".join(str(row[name]) for name in KEY).replace(":", "+")
    renderer = Renderer(args.device)
    runs.add(
        row
        | measure(scene, decision.config, folder)
        | {"decided": list(decision.reasons), "options": changes(decision.config)}
        | environment(renderer.device, renderer.schedule)
    )
    last = runs.rows[-1]
    print(f"{case} {method.label} seed {seed}: {last['psnr']} (training {last['train_psnr']}) dB", file=sys.stderr)


def page(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table for each case: means over the seeds, and their spread."""
    parts = []
    for (scene, resolution, cap, iterations, views), chosen in groups(rows, *KEY[:4], "views").items():
        lines = []
        for (system,), same in groups(chosen, "system").items():
            psnr = [row["psnr"] for row in same]
            mean = {
                name: statistics.fmean(row[name] for row in same)
                for name in ("psnr", "ssim", "train_psnr", "splats", "seconds")
            }
            lines.append(
                (
                    system,
                    f"{mean['psnr']:.2f}{spread(psnr)}",
                    f"{mean['train_psnr']:.2f}",
                    f"{mean['ssim']:.4f}",
                    f"{mean['splats']:.0f}",
                    f"{mean['seconds']:.0f}",
                    len(same),
                )
            )
        head = ("system", "PSNR", "training PSNR", "SSIM", "splats", "seconds", "seeds")
        size = "" if resolution == -1 else f" -r {resolution}"
        parts.append(f"**{scene}{size}, {cap} splats, {iterations} iterations, {views} views**\n")
        parts.append(table(head, lines, right=head[1:]) + "\n")
    return "\n".join(parts)


def test_table(rows: list[dict[str, Any]], scenes: Sequence[str]) -> str:
    """Return a Markdown table of the runs at full size on test views of some scenes, in their order.

    Variants of a system are left out, but for those without small images (NO_SMALL_IMAGES).
    """
    plain = [r for r in rows if r["views"] == "test" and r["resolution"] == -1 and r["scene"] in scenes]
    plain = [r for r in plain if not set(r["system"].removesuffix(NO_SMALL_IMAGES)) & {" ", ":"}]
    cases = groups(plain, "scene", "cap", "iterations").items()
    lines = []
    for (scene, cap, iterations), case in sorted(cases, key=lambda item: (scenes.index(item[0][0]), *item[0][1:])):
        means = {name: statistics.fmean(r["psnr"] for r in same) for (name,), same in groups(case, "system").items()}
        for system in sorted(means, key=means.__getitem__, reverse=True):
            same = [r for r in case if r["system"] == system]
            psnr = [r["psnr"] for r in same]
            shown = f"{means[system]:.2f}"
            shown = f"**{shown}**" if system == max(means, key=means.__getitem__) else shown
            lines.append(
                (
                    f"`{scene}`",
                    f"{cap:,}".replace(",", " "),
                    f"{iterations:,}".replace(",", " "),
                    system,
                    shown + spread(psnr),
                    f"{statistics.fmean(r['ssim'] for r in same):.4f}",
                    f"{statistics.fmean(r['train_psnr'] for r in same):.2f}",
                    f"{statistics.fmean(r['seconds'] for r in same) / 60:.1f}",
                )
            )
    head = ("scene", "splats", "iterations", "system", "PSNR", "SSIM", "PSNR of training views", "minutes")
    return table(head, lines, right=(*head[1:3], *head[4:]))


def main() -> None:
    flags = parser(__doc__, RESULTS / "defaults.jsonl", smoke=False, page=PAGE)
    flags.add_argument("--cases", nargs="+", default=["lego:-1:30000:1500", "fox:2:20000:1000"])
    flags.add_argument("--systems", default="default")
    flags.add_argument("--seeds", nargs="+", type=int, default=[0])
    flags.add_argument("--views", choices=("validation", "test"), default="validation")
    flags.add_argument("--work", type=Path, help="folder of the models, for runs that may be interrupted")
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        for marks, scenes in TABLES.items():
            write_between(PAGE, *marks, test_table(runs.rows, scenes))
        return
    if not args.table:
        for seed in args.seeds:
            for case in map(Case.parse, args.cases):
                for method in parse_methods(args.systems):
                    run(case, method, seed, args, runs)
    print(page(runs.rows))


if __name__ == "__main__":
    main()
