"""`--budget auto` beside runs at several caps: what the search keeps, what it loses, and how long it takes.

    python benchmarks/budget.py --cases fox:4:12000:1000 kitchen:-1:20000:1000 --seeds 0 1 2
    python benchmarks/budget.py --cases fox:2:50000:1000 --views test      # once, after the choice
    python benchmarks/budget.py --table
    python benchmarks/budget.py --page         # write the table and the chart of docs/small-models.md

A case is scene:resolution:cap:iterations. The search stands beside runs of the default at the cap and at parts of it,
with the same seed and photos. Both are measured on test views, or on validation views that neither has seen: the search
holds out views of its own. A search that was killed continues (in --work). The time of the search is divided by that of
the run at the cap.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from common import RESULTS, ROOT, Case, Runs, background_of, environment, groups, parser, table, write_between

from clsplat.comparison.measure import warm_up
from clsplat.comparison.search_chart import rounds_chart
from clsplat.compression.rules import TOLERANCE, BudgetOptions
from clsplat.compression.search import train_budget
from clsplat.compression.state import BudgetState
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

KEY = ("scene", "resolution", "cap", "iterations", "shape", "tolerance", "seed", "views")
DECIDED = "default"
SHARES = (1.0, 0.4, 0.1)  # of the cap: the runs beside a search
PAGE = ROOT / "docs" / "small-models.md"
MARKS = ("<!-- table of budget.py -->", "<!-- end of the table of budget.py -->")
CHART, SHOWN = ROOT / "docs" / "images" / "rounds.png", "south_building_large"
HEAD = ("scene", "kernel", "views", "seeds", "best cap: PSNR [dB]", "auto: PSNR [dB]", "splats", "bytes", "time")


def search(case: Case, seed: int, args: Any, runs: Runs) -> None:
    """Run a search and the runs beside it, if they are not among `runs`."""
    row: dict[str, Any] = vars(case) | {
        "shape": args.shape,
        "tolerance": args.tolerance,
        "seed": seed,
        "views": args.views,
    }
    if row in runs:
        return
    background = background_of(case.scene)
    scene = case.load(args.views)
    config = TrainConfig(
        **({} if args.shape == DECIDED else {"shape": args.shape}),
        iterations=case.iterations,
        cap_max=case.cap,
        seed=seed,
        background=background,
        device=args.device,
    )
    renderer = Renderer(config.device)
    warm_up(scene, config, renderer.device)
    plain = [plain_run(scene, config.replace(cap_max=max(round(share * case.cap), 1)), renderer) for share in SHARES]
    work = args.work / "-".join(str(row[name]) for name in KEY)
    resume = (work / BudgetState.FILE).is_file()
    result = train_budget(
        scene, config, BudgetOptions(args.tolerance), output=work, resume=resume, overwrite=not resume
    )
    found = evaluate(renderer, result.splats, scene.test, background)
    best = max(plain, key=lambda run: float(run["psnr"]))
    row |= {
        "plain": plain,
        "psnr": round(found.psnr, 3),
        "ssim": round(found.ssim, 4),
        "splats": len(result.splats),
        "kernel": result.splats.shape,
        "bytes": result.path.stat().st_size,
        "seconds": round(result.seconds, 1),
        "search": {key: result.report[key] for key in ("rounds", "chosen", "held_out", "all_views", "final")},
    }
    runs.add(row | environment(renderer.device, renderer.schedule))
    print(
        f"{case} seed {seed}: {found.psnr:.2f} dB with {len(result.splats)} splats in {row['seconds']} s; best cap "
        f"{best['cap']}: {best['psnr']:.2f} dB in {best['seconds']} s",
        file=sys.stderr,
    )


def plain_run(scene: Scene, config: TrainConfig, renderer: Renderer) -> dict[str, Any]:
    """Train with one cap and return what the model is like."""
    with tempfile.TemporaryDirectory() as folder:
        model = train(scene, config, output=Path(folder) / "model")
        assert model.path is not None
        size = sum(file.stat().st_size for file in model.path.glob("point_cloud/*/point_cloud.ply"))
    return {
        "cap": config.cap_max,
        "splats": len(model.splats),
        "bytes": size,
        "psnr": round(evaluate(renderer, model.splats, scene.test, config.background).psnr, 3),
        "seconds": round(model.seconds, 3),
    }


def page(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table with a row for each case: means over the seeds, and the best of its caps."""
    lines = []
    for (scene, resolution, iterations, shape, tolerance, views), case in groups(
        sorted(rows, key=lambda row: row["views"] == "test"),
        "scene",
        "resolution",
        "iterations",
        "shape",
        "tolerance",
        "views",
    ).items():
        plain = [
            (statistics.fmean(run["psnr"] for run in same), same)
            for same in zip(*(row["plain"] for row in case), strict=True)
        ]
        best, runs = max(plain, key=lambda item: item[0])
        whole = statistics.fmean(row["plain"][0]["seconds"] for row in case)
        lines.append(
            (
                f"`{scene}`{'' if resolution == -1 else f' `-r {resolution}`'}, {iterations} iterations"
                + ("" if tolerance == TOLERANCE else f", {tolerance:g} dB"),
                case[0].get("kernel", shape),
                views,
                len(case),
                f"{runs[0]['cap']}: {best:.2f}",
                f"{statistics.fmean(row['psnr'] for row in case):.2f}",
                f"{sum(row['splats'] for row in case) / sum(run['splats'] for run in runs):.0%}",
                f"{sum(row['bytes'] for row in case) / sum(run['bytes'] for run in runs):.0%}",
                f"{statistics.fmean(row['seconds'] for row in case) / whole:.1f}",
            )
        )
    return table(HEAD, lines, right=HEAD[3:])


def main() -> None:
    flags = parser(__doc__, RESULTS / "budget.jsonl", page=PAGE)
    flags.add_argument("--cases", nargs="+", default=["fox:4:12000:1000"])
    flags.add_argument("--shape", default=DECIDED, help="kernel of all runs; by default that which a run decides on")
    flags.add_argument("--seeds", nargs="+", type=int, default=[0])
    flags.add_argument("--tolerance", type=float, default=TOLERANCE)
    flags.add_argument("--views", choices=("validation", "test"), default="validation")
    flags.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "clsplat-budget")
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *MARKS, page(runs.rows))
        shown = next(row for row in runs.rows if row["scene"] == SHOWN)
        for file in rounds_chart(shown["search"], CHART):
            if file.suffix != CHART.suffix:
                file.unlink()
        return
    if args.smoke:
        args.tolerance = 1.0
        args.cases = [f"{text.split(':')[0]}:-1:60:8" for text in args.cases]
    if not args.table:
        for case in map(Case.parse, args.cases):
            for seed in args.seeds:
                search(case, seed, args, runs)
    print(page(runs.rows))


if __name__ == "__main__":
    main()
