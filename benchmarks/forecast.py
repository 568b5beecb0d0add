"""How well the time left of a run is forecast; a JSON line a run.

    python benchmarks/forecast.py [--runs fox lego]
    python benchmarks/forecast.py --table                     # print the finished runs, run nothing

The processor's time is forecast and measured instead of the wall's, because other programs on the machine change the
latter. `worst` is the largest error from the first tenth of the run until 3 % before its end.
"""

from __future__ import annotations

import time
from typing import Any

import common

from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer

# Scene, reduction of the photos, options.
RUNS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "fox": ("fox", 2, {"iterations": 2000, "cap_max": 20_000}),
    "lego": ("lego", 1, {"iterations": 1500, "cap_max": 15_000, "strategy": "mcmc", "background": (1.0, 1.0, 1.0)}),
    "kitchen_large": ("kitchen_large", 2, {"iterations": 2000, "cap_max": 30_000}),
    "fox-full-size": ("fox", 1, {"iterations": 1500, "cap_max": 40_000, "coarse_to_fine": False}),
}
COLUMNS = ("run", "seconds", "first_estimate", "at_a_tenth", "at_a_half", "worst", "beyond_20_percent", "commit")


def measure(name: str) -> dict[str, Any]:
    scene_name, resolution, options = RUNS[name]
    config = TrainConfig(**options)
    scene = load_scene(common.data_folder() / scene_name, resolution=resolution, background=config.background)
    trainer = Trainer(scene, config, progress=lambda _: None)
    clock, forecast = trainer.clock, trainer.clock.forecast
    clock.clock = time.process_time
    seconds, forecasts = [0.0], [0.0]
    observe = forecast.observe

    def observed(iteration: int, n_splats: int, spent: float) -> None:
        if len(forecasts) == 1:
            forecasts[0] = forecast.seconds_left() or 0.0
        observe(iteration, n_splats, spent)
        seconds.append(seconds[-1] + spent)
        forecasts.append((forecast.seconds_left() or 0.0) if iteration % 10 == 0 else 0.0)

    forecast.observe = observed  # type: ignore[method-assign]
    trainer.run()
    total, n = seconds[-1], config.iterations
    errors = {it: forecasts[it] / (total - seconds[it]) - 1 for it in range(10, n, 10)}
    counted = [abs(error) for it, error in errors.items() if 0.1 * n <= it <= 0.97 * n]
    return {
        "run": name,
        "options": options,
        "splats": trainer.splats.n,
        "seconds": round(total, 1),
        "first_estimate": round(forecasts[0] / total - 1, 3),
        "at_a_tenth": round(errors[n // 100 * 10], 3),
        "at_a_half": round(errors[n // 20 * 10], 3),
        "worst": round(max(counted), 3),
        "beyond_20_percent": round(sum(error > 0.2 for error in counted) / len(counted), 3),
        "errors": [round(errors[n * part // 200 * 10], 2) for part in range(1, 20)],  # at 5 %, 10 %, ... of the run
        "device": str(trainer.device.info),
        "commit": common.commit(),
    }


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "forecast.jsonl", device=False, smoke=False)
    parser.add_argument("--runs", nargs="+", choices=list(RUNS), default=list(RUNS))
    args = parser.parse_args()
    for name in () if args.table else args.runs:
        common.append(args.out, measure(name))
    rows = common.read(args.out)
    print(common.table(COLUMNS, [[row[column] for column in COLUMNS] for row in rows]))


if __name__ == "__main__":
    main()
