"""No more model than the scene needs: growth while it pays, then fewer splats, then fewer parameters of each.

Everything is decided on validation views, held out of the training set (validation.py); test views are never looked at.

    growth    short runs (a quarter of the iterations), the cap doubling, until two doublings have gained less than the
              tolerance; the knee is the smallest cap within half of it of the best. Where a smaller cap is within the
              standard error (over views) of the best, too, a whole run of each decides
    rounds    from a whole run at the knee, rounds that remove a quarter of the splats and train the others on
              (shrink.py), until two have a PSNR lower than the best so far, which most often is not the first, by more
              than a quarter of the tolerance and what the knee has left of its half; the fewest splats that have not
              are taken, and trained on at lower rates
    parts     of that model, the fields and bands that the last quarter allows (prune.py)
    refit     the same with all training views: the run at the knee, as many rounds, the thresholds found before

A target of PSNR or bytes replaces the tolerance as what ends the rounds. Finished stages are kept (budget_state.py).
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..device.device import Device, open_device
from ..errors import OutputError
from ..files.lock import folder_lock
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene
from ..scenes.split import hold_out
from ..splats.splats import Splats
from ..splats.stats import complexity
from ..training.config import TrainConfig
from ..training.folder import ModelFolder, scene_record
from ..training.log import Progress
from ..training.run import train
from ..training.trainer import Trainer
from .prune import Thresholds, Validation, apply_thresholds, prune, within_bytes
from .prune_and_refine import SETTLING, fine_tune, without_messages, without_quarter
from .rules import (
    FEWEST,
    PARTS_SHARE,
    BudgetOptions,
    ModelRow,
    candidates,
    chosen_of,
    growth_caps,
    growth_is_over,
    knee_of,
    rounds_are_over,
)
from .state import BudgetState

GROWTH_PART, ROUND_PART = 4, 10  # the run's iterations over those of a run of growth, and of a round

ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Budgeted:
    """The result of a search.

    Attributes
    ----------
    splats : the model. path : of its file. finished : False: interrupted, and to be resumed.
    report : what budget.json holds: growth, knee, rounds, what went, and what was reached.
    """

    splats: Splats
    path: Path
    finished: bool
    report: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Of all stages: growth, held-out run, rounds, parts, refit."""
        report = self.report
        stages = [
            *report.get("growth", []),
            *report.get("whole", []),
            *report.get("rounds", [])[1:],
            report.get("held_out", {}),
            report.get("refit", {}),
        ]
        return float(sum(stage.get("seconds", 0.0) for stage in stages))


def train_budget(
    scene: Scene,
    config: TrainConfig | None = None,
    options: BudgetOptions | None = None,
    progress: ProgressCallback | None = None,
    *,
    output: str | Path,
    resume: bool = False,
    overwrite: bool = False,
) -> Budgeted:
    """Learn the smallest model that a scene needs.

    Parameters
    ----------
    config : of a whole run; its `cap_max` is the largest cap that is tried. progress : as `train`'s.
    output : model folder: besides what `train` writes, budget.json, and the small model as its last point cloud.
    resume : go on after the last stage that is done; the options must be the same. overwrite : as `train`'s.

    Raises
    ------
    InputError : too few training views, options that do not fit, or a target that no model can meet.
    OutputError, DeviceError, TrainingError : as `train`. KeyboardInterrupt : Ctrl-C; stages that are done are kept.
    """
    config, options = config or TrainConfig(), options or BudgetOptions()
    state = BudgetState(Path(output))
    folder = ModelFolder(output)
    if resume:
        state.load()
        state.check(config, options)
    elif (folder.is_used or state.path.exists()) and not overwrite:
        raise OutputError(f"{folder.path}: already holds a model: use --overwrite, --resume or another folder")
    folder.prepare()
    with folder_lock(folder.path):
        if not resume:
            folder.clear()
            state.begin(config, options, scene_record(scene))
        return _Search(scene, config, options, progress, state, folder).run()


class _Search:
    """The stages, each done once."""

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        options: BudgetOptions,
        progress: ProgressCallback | None,
        state: BudgetState,
        folder: ModelFolder,
    ) -> None:
        self.scene, self.config, self.options, self.progress = scene, config, options, progress
        self.state, self.folder = state, folder
        self.split = hold_out(scene)
        self.device: Device = open_device(config.device)
        self.renderer = Renderer(self.device)
        self.validation = Validation(self.renderer, self.split.test, config.background)
        self.part = max(config.iterations // ROUND_PART, 1)

    def run(self) -> Budgeted:
        """All that is left to do."""
        values = self.state.values
        stages = {"candidates": self.grow, "knee": self.decide, "chosen": self.shrink, "thresholds": self.find_parts}
        for key, stage in stages.items():
            if key not in values:
                stage()
        if "refit" not in values:
            resume = self.folder.checkpoint_path.is_file()
            config = self.config.replace(cap_max=values["knee"])
            self.say(f"refit: all {len(self.scene.train)} training views, at most {values['knee']} splats")
            model = train(
                self.scene,
                config,
                self.progress,
                output=self.folder.path,
                resume=resume,
                overwrite=not resume,
            )
            if not model.finished:
                return Budgeted(model.splats, self.folder.path, False, values)
            self.state.save("refit_0", model.splats)
            self.state.put("refit", {"splats": len(model.splats), "seconds": round(model.seconds, 2), "done": 0})
        return self.finish()

    def grow(self) -> None:
        """Short runs at rising caps."""
        iterations = max(self.config.iterations // GROWTH_PART, 1)
        interval = max(self.config.density.densify_interval // GROWTH_PART, 1)
        rows: list[ModelRow] = self.state.values.get("growth", [])
        for cap in growth_caps(self.config.cap_max):
            if any(row["cap"] == cap for row in rows):
                continue
            if growth_is_over(rows, self.options):
                break
            self.say(f"growth: at most {cap} splats, {iterations} iterations")
            config = self.config.replace(
                cap_max=cap,
                iterations=iterations,
                densify_interval=interval,
                save_iterations=(),
                test_iterations=(),
            )
            splats, seconds = self.run_of(config)
            views = self.validation.per_view(splats)
            rows = [
                *rows,
                {
                    "cap": cap,
                    "splats": len(splats),
                    "psnr": statistics.fmean(views),
                    "views": views,
                    "seconds": seconds,
                },
            ]
            self.state.put("growth", rows)
            if len(splats) < cap:  # it grows no further by itself
                break
        self.state.put("candidates", candidates(rows, self.options))

    def decide(self) -> None:
        """A whole run at each cap that may be the knee."""
        rows: list[ModelRow] = self.state.values.get("whole", [])
        for cap in self.state.values["candidates"]:
            if any(row["cap"] == cap for row in rows):
                continue
            self.say(
                f"held out: at most {cap} splats, {len(self.split.train)} training views, "
                f"{len(self.split.test)} validation views"
            )
            splats, seconds = self.run_of(self.config.replace(cap_max=cap, save_iterations=(), test_iterations=()))
            self.state.save(f"whole_{cap}", splats)
            rows = [*rows, {"cap": cap, **self.row(splats, seconds)}]
            self.state.put("whole", rows)
        self.state.put("knee", knee_of(rows, self.options))

    def shrink(self) -> None:
        """Rounds."""
        values, goal = self.state.values, self.options
        if "rounds" not in values:
            self.state.save("held_out_0", self.state.model(f"whole_{values['knee']}"))
            knee = next(row for row in values["whole"] if row["cap"] == values["knee"])
            best = max(row["psnr"] for row in values["whole"])
            self.state.put("rounds", [knee | {"lost": best - knee["psnr"]}])
        rows: list[ModelRow] = values["rounds"]
        while not rounds_are_over(rows, goal):
            start = time.perf_counter()
            splats = self.round(self.split, self.state.model(f"held_out_{len(rows) - 1}"), len(rows))
            self.state.save(f"held_out_{len(rows)}", splats)
            rows = [*rows, self.row(splats, round(time.perf_counter() - start, 2))]
            self.state.put("rounds", rows)
        self.state.put("chosen", chosen_of(rows, goal))

    def find_parts(self) -> None:
        """Fields and bands that the validation views do not miss."""
        values, start = self.state.values, time.perf_counter()
        splats = self.settle(self.split, self.state.model(f"held_out_{values['chosen']}"), values["chosen"])
        now = self.validation.psnr(splats)
        allowed = PARTS_SHARE * self.options.tolerance
        if self.options.target_psnr is not None:
            allowed = max(now - self.options.target_psnr, 0.0)
        found = prune(splats, self.split.train, self.validation, allowed, ("fields", "bands"), self.config.seed)
        small = found.splats
        if self.options.max_bytes is not None:
            small = self.fitted(small, self.split) or small
        self.state.put(
            "held_out",
            {
                "psnr": now,
                "psnr_pruned": self.validation.psnr(small),
                "costs": found.costs,
                "seconds": round(time.perf_counter() - start, 2),
                **complexity(small).to_json(),
            },
        )
        self.state.put("thresholds", {"fields": found.thresholds.fields, "bands": found.thresholds.bands})

    def finish(self) -> Budgeted:
        """Rounds, thresholds and the file of the refitted model."""
        values = self.state.values
        start = time.perf_counter()
        done = values["refit"]["done"]
        splats = self.state.model(f"refit_{done}")
        while done < values["chosen"]:
            splats, done = self.round(self.scene, splats, done + 1), done + 1
            self.state.save(f"refit_{done}", splats)
            self.state.put("refit", values["refit"] | {"done": done})
        splats = self.settle(self.scene, splats, done)
        found = values["thresholds"]
        thresholds = Thresholds(0.0, found["fields"], found["bands"])
        splats = apply_thresholds(
            splats, self.scene.train, self.renderer, thresholds, self.config.background, self.config.seed
        )
        if self.options.max_bytes is not None:
            splats = self.fitted(splats, self.scene) or splats
        path = self.folder.ply_path(self.config.iterations + self.part * (done + 1 if done else 0))
        splats.save(path, compact=True)
        missed = self.missed(path.stat().st_size)
        report = complexity(splats).to_json() | {"bytes": path.stat().st_size, "missed": missed}
        self.state.put(
            "refit", values["refit"] | {"seconds": values["refit"]["seconds"] + round(time.perf_counter() - start, 2)}
        )
        self.state.put("final", report)
        self.state.end()
        return Budgeted(splats, path, True, values)

    def round(self, scene: Scene, splats: Splats, number: int) -> Splats:
        """A quarter fewer splats, trained on."""
        fewer = without_quarter(splats, scene.train, self.renderer, self.config.background, self.config.seed, FEWEST)
        self.say(f"round {number}: {len(fewer)} splats, {self.part} iterations")
        return fine_tune(scene, fewer, self.config, self.part, self.device, self.progress)

    def settle(self, scene: Scene, splats: Splats, rounds: int) -> Splats:
        """The last part, at lower rates; without rounds the run's own end was it."""
        if not rounds:
            return splats
        self.say(f"last part: {len(splats)} splats, {self.part} iterations at lower rates")
        return fine_tune(scene, splats, self.config, self.part, self.device, self.progress, SETTLING)

    def run_of(self, config: TrainConfig) -> tuple[Splats, float]:
        """A training run without the held-out views; and its seconds."""
        model = Trainer(self.split, config, progress=without_messages(self.progress), device=self.device).run()
        return model.splats, round(model.seconds, 2)

    def row(self, splats: Splats, seconds: float) -> ModelRow:
        """A model of the rounds; with a limit of bytes, as good as it is once it fits."""
        row: ModelRow = {"splats": len(splats), "psnr": self.validation.psnr(splats), "seconds": seconds}
        if self.options.max_bytes is not None:
            fitted = self.fitted(splats, self.split)
            row |= {"fitted_psnr": None if fitted is None else self.validation.psnr(fitted)}
        return row

    def fitted(self, splats: Splats, scene: Scene) -> Splats | None:
        """The model within the limit of bytes, if it can be."""
        assert self.options.max_bytes is not None
        return within_bytes(
            splats, scene.train, self.renderer, self.options.max_bytes, self.config.background, self.config.seed
        )

    def missed(self, nbytes: int) -> str | None:
        """What of the targets was not met, in one sentence."""
        options, reached = self.options, self.state.values["held_out"]["psnr_pruned"]
        said = []
        if options.target_psnr is not None and reached < options.target_psnr:
            said.append(
                f"target PSNR {options.target_psnr:g} dB was not reached: the best model, which is kept, has "
                f"{reached:.2f} dB on validation views: try more --iterations or a higher --cap-max"
            )
        if options.max_bytes is not None and nbytes > options.max_bytes:
            said.append(f"{nbytes} bytes are more than {options.max_bytes}: the smallest model tried is kept")
        return "; ".join(said) or None

    def say(self, message: str) -> None:
        """Tell the display what begins."""
        if self.progress is not None:
            self.progress(Progress(0, self.config.iterations, math.nan, math.nan, 0, 0.0, 0.0, message))
