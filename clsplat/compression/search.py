"""Search for the smallest model of a scene: growth, then fewer splats, then fewer parameters of each splat.

All decisions are made on validation views, held out of the training set (scenes/split.py). Test views are never used.

1. Growth. Short runs (a quarter of the iterations) double the cap, until two doublings gain less than the tolerance.
   The knee is the smallest cap within half of the tolerance of the best. If a smaller cap is within the standard error
   (over views) of the best, a whole run of each decides.
2. Rounds. They start from a whole run at the knee. Each round removes a quarter of the splats and fine-tunes the others
   (prune_and_refine.py). The allowed loss to the best round is a quarter of the tolerance and the unused part of the
   knee's half. The rounds stop after two models below that line. The smallest model above it is fine-tuned once more at
   lower rates.
3. Parts. The last quarter of the tolerance allows fields and bands of that model to be removed (prune.py).
4. Refit. The same steps with all training views: the run at the knee, the same number of rounds, the same thresholds.

A target of PSNR or bytes replaces the tolerance as the condition that ends the rounds. state.py keeps finished stages.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
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
from ..training.decisions import as_decided, decide
from ..training.folder import ModelFolder, scene_record
from ..training.log import Progress
from ..training.run import train
from ..training.trainer import Trainer
from .prune import Thresholds, Validation, apply_thresholds, prune, within_bytes
from .prune_and_refine import FINAL_RATE, fine_tune, without_messages, without_quarter
from .rules import (
    MIN_SPLATS,
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

PHASES = 5  # growth, whole runs, rounds, parts, refit
GROWTH_PART, ROUND_PART = 4, 10  # iterations of the run over those of a growth run, and of a round

ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Budgeted:
    """The result of a search.

    Attributes
    ----------
    splats : the model. path : its file. finished : False after an interruption; the search can be resumed.
    report : content of budget.json: growth, knee, rounds, removed parts and the result.
    """

    splats: Splats
    path: Path
    finished: bool
    report: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Seconds of all stages: growth, held-out run, rounds, parts, refit."""
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
    config : options of a whole run; its `cap_max` is the largest cap that is tried. progress : as of `train`.
    output : model folder. It gets the files of `train`, budget.json, and the small model as its last point cloud.
    resume : continue after the last finished stage, with the same options. overwrite : as of `train`.

    Raises
    ------
    InputError : too few training views, other options than before, or a target that no model can meet.
    OutputError, DeviceError, TrainingError : as `train`. KeyboardInterrupt : Ctrl-C; finished stages are kept.
    """
    config, options = config or TrainConfig(), options or BudgetOptions()
    state = BudgetState(Path(output))
    folder = ModelFolder(output)
    if resume:
        state.load()
        config = as_decided(config, TrainConfig.from_json(state.values["config"]).to_json())
        state.check(config, options)
    elif (folder.is_used or state.path.exists()) and not overwrite:
        raise OutputError(f"{folder.path}: already holds a model: use --overwrite, --resume or another folder")
    folder.prepare()
    if not resume:
        config = decide(scene, config).tell(progress)
    with folder_lock(folder.path):
        if not resume:
            folder.clear()
            state.begin(config, options, scene_record(scene, folder.path))
        return _Search(scene, config, options, progress, state, folder).run()


class _Search:
    """The stages of a search, each done once."""

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        options: BudgetOptions,
        progress: ProgressCallback | None,
        state: BudgetState,
        folder: ModelFolder,
    ) -> None:
        self.scene, self.config, self.options, self.report = scene, config, options, progress
        self.progress: ProgressCallback | None = progress and self._with_phase
        self.phase = 1
        self.state, self.folder = state, folder
        self.split = hold_out(scene)
        self.device: Device = open_device(config.device)
        self.renderer = Renderer(self.device)
        self.validation = Validation(self.renderer, self.split.test, config.background)
        self.part = max(config.iterations // ROUND_PART, 1)

    def run(self) -> Budgeted:
        """Run the missing stages."""
        values = self.state.values
        stages = {
            "candidates": self.grow,
            "knee": self.decide,
            "chosen": self.remove_splats,
            "thresholds": self.find_parts,
        }
        for key, stage in stages.items():
            if key not in values:
                stage()
        if "refit" not in values:
            resume = self.folder.checkpoint_path.is_file()
            config = self.config.replace(cap_max=values["knee"])
            self.report_message(
                5, f"refit: all {len(self.scene.train)} training views, at most {values['knee']} splats"
            )
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
        """Make short runs at rising caps."""
        iterations = max(self.config.iterations // GROWTH_PART, 1)
        interval = max(self.config.density.densify_interval // GROWTH_PART, 1)
        rows: list[ModelRow] = self.state.values.get("growth", [])
        for cap in growth_caps(self.config.cap_max):
            if any(row["cap"] == cap for row in rows):
                continue
            if growth_is_over(rows, self.options):
                break
            self.report_message(1, f"growth: at most {cap} splats, {iterations} iterations")
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
            if len(splats) < cap:  # a larger cap would give the same run
                break
        self.state.put("candidates", candidates(rows, self.options))

    def decide(self) -> None:
        """Make a whole run at each cap that may be the knee."""
        rows: list[ModelRow] = self.state.values.get("whole", [])
        for cap in self.state.values["candidates"]:
            if any(row["cap"] == cap for row in rows):
                continue
            self.report_message(
                2,
                f"held out: at most {cap} splats, {len(self.split.train)} training views, "
                f"{len(self.split.test)} validation views",
            )
            splats, seconds = self.run_of(self.config.replace(cap_max=cap, save_iterations=(), test_iterations=()))
            self.state.save(f"whole_{cap}", splats)
            rows = [*rows, {"cap": cap, **self.row(splats, seconds)}]
            self.state.put("whole", rows)
        self.state.put("knee", knee_of(rows, self.options))

    def remove_splats(self) -> None:
        """Run rounds that remove splats."""
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
        """Find the fields and bands that the validation views do not need."""
        values, start = self.state.values, time.perf_counter()
        splats = self.final_part(self.split, self.state.model(f"held_out_{values['chosen']}"), values["chosen"])
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
        """Repeat the rounds and thresholds on the refitted model, and write its file."""
        values = self.state.values
        start = time.perf_counter()
        done = values["refit"]["done"]
        splats = self.state.model(f"refit_{done}")
        while done < values["chosen"]:
            splats, done = self.round(self.scene, splats, done + 1), done + 1
            self.state.save(f"refit_{done}", splats)
            self.state.put("refit", values["refit"] | {"done": done})
        splats = self.final_part(self.scene, splats, done)
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
        """Remove a quarter of the splats and train the others on."""
        fewer = without_quarter(
            splats, scene.train, self.renderer, self.config.background, self.config.seed, MIN_SPLATS
        )
        self.report_message(
            5 if scene is self.scene else 3, f"round {number}: {len(fewer)} splats, {self.part} iterations"
        )
        return fine_tune(scene, fewer, self.config, self.part, self.device, self.progress)

    def final_part(self, scene: Scene, splats: Splats, rounds: int) -> Splats:
        """Fine-tune at lower rates; without rounds the end of the run did that already."""
        if not rounds:
            return splats
        self.report_message(
            5 if scene is self.scene else 4, f"last part: {len(splats)} splats, {self.part} iterations at lower rates"
        )
        return fine_tune(scene, splats, self.config, self.part, self.device, self.progress, FINAL_RATE)

    def run_of(self, config: TrainConfig) -> tuple[Splats, float]:
        """Train without the held-out views; return the model and the seconds."""
        model = Trainer(self.split, config, progress=without_messages(self.progress), device=self.device).run()
        return model.splats, round(model.seconds, 2)

    def row(self, splats: Splats, seconds: float) -> ModelRow:
        """Return the row of a model; with a limit of bytes also its PSNR once it fits."""
        row: ModelRow = {"splats": len(splats), "psnr": self.validation.psnr(splats), "seconds": seconds}
        if self.options.max_bytes is not None:
            fitted = self.fitted(splats, self.split)
            row |= {"fitted_psnr": None if fitted is None else self.validation.psnr(fitted)}
        return row

    def fitted(self, splats: Splats, scene: Scene) -> Splats | None:
        """Return the model within the limit of bytes; None if it cannot fit."""
        assert self.options.max_bytes is not None
        return within_bytes(
            splats, scene.train, self.renderer, self.options.max_bytes, self.config.background, self.config.seed
        )

    def missed(self, nbytes: int) -> str | None:
        """Return a sentence for each target that was not met; None if all are met."""
        options, reached = self.options, self.state.values["held_out"]["psnr_pruned"]
        sentences = []
        if options.target_psnr is not None and reached < options.target_psnr:
            sentences.append(
                f"target PSNR {options.target_psnr:g} dB was not reached: the best model, which is kept, has "
                f"{reached:.2f} dB on validation views: try more --iterations or a higher --cap-max"
            )
        if options.max_bytes is not None and nbytes > options.max_bytes:
            sentences.append(f"{nbytes} bytes are more than {options.max_bytes}: the smallest model tried is kept")
        return "; ".join(sentences) or None

    def report_message(self, phase: int, message: str) -> None:
        """Send a message to the display, and name the phase of the search (from 1) in all that follows."""
        self.phase = phase
        if self.report is not None:
            text = f"step {phase} of {PHASES}, {message}"
            self.report(Progress(0, self.config.iterations, math.nan, math.nan, 0, 0.0, 0.0, text))

    def _with_phase(self, report: Progress) -> None:
        """Send a report of one run to the display, with the phase of the search."""
        if self.report is not None:
            self.report(replace(report, phase=f"step {self.phase} of {PHASES}"))
