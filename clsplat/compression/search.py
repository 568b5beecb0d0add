"""Search for the smallest model of a scene: how many rounds of pruning, and which parts, the images do not miss.

All decisions are made on validation views, held out of the training set (scenes/split.py). Test views are never used.

1. Trial. A run of half the length with all splats, without the validation views.
2. Rounds. Each removes a quarter of the splats and fine-tunes the others (prune_and_refine.py). The rounds stop after
   two models that lost more than their share of the tolerance against the best one. The smallest model that surely did
   not is chosen (rules.py).
3. Parts. The last quarter of the tolerance allows fields and bands of that model to be removed (prune.py).
4. All views. A whole run with all training views, the same number of rounds, and the same thresholds of parts.

A target of PSNR or bytes replaces the tolerance as the condition that ends the rounds. state.py keeps finished stages.
An interrupted stage goes on from its checkpoint.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cluster.job import Job
from ..cluster.pool import WorkerPool, check_cluster
from ..cluster.training import TrainJob, marked, train_in_place, unmark
from ..rendering.renderer import Renderer
from ..scenes.in_memory import with_small_photos_in_memory
from ..scenes.scene import Scene
from ..scenes.source import SceneSource
from ..scenes.split import hold_out
from ..splats.splats import Splats
from ..splats.stats import complexity
from ..training.config import TrainConfig
from ..training.decisions import as_decided, decide
from ..training.exposure_file import copy_exposures, exposures_beside
from ..training.folder import ModelFolder, scene_record
from ..training.log import Progress
from ..training.point_fit import with_fitting_points
from ..training.run import train
from ..training.stages import StepReports
from ..training.stored_run import holds_run
from .prune import Thresholds, Validation, apply_thresholds, prune, within_bytes
from .prune_and_refine import ROUND, fine_tuning, without_messages, without_quarter
from .rules import MIN_SPLATS, PARTS_SHARE, BudgetOptions, ModelRow, chosen_of, rounds_are_over
from .state import BudgetState

STEPS = 4  # trial, rounds, parts, all views
TRIAL_PART = 2  # iterations of the run over those of the trial

ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Budgeted:
    """The result of a search.

    Attributes
    ----------
    splats : the model. path : its file.
    report : content of budget.json: the rounds (the first is the trial), the removed parts and the result.
    """

    splats: Splats
    path: Path
    report: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Seconds of all stages. An interrupted stage counts from its last start."""
        report = self.report
        stages = (*report["rounds"], report["held_out"], *report["all_views"], report["final"])
        return float(sum(stage["seconds"] for stage in stages))


def train_budget(
    scene: Scene,
    config: TrainConfig | None = None,
    options: BudgetOptions | None = None,
    progress: ProgressCallback | None = None,
    *,
    output: str | Path,
    resume: bool = False,
    overwrite: bool = False,
    cluster: str | None = None,
) -> Budgeted:
    """Learn the smallest model that a scene needs.

    Parameters
    ----------
    config : options of a whole run; its `cap_max` is the largest cap that is tried. progress : as of `train`.
    output : model folder. It gets the files of `train`, budget.json, and the small model as its last point cloud.
    resume : continue an interrupted search, with the same options. overwrite : as of `train`.
    cluster : address of workers (`cluster.address`) that make the trial and the run of all views at the same time. They
        must see `output`. The rest of the search is done by this process.

    Raises
    ------
    InputError : too few training views, other options than before, or a target that no model can meet.
    ClusterError : as `WorkerPool`.
    OutputError, DeviceError, TrainingError : as `train`. KeyboardInterrupt : Ctrl-C; `resume` goes on from there.
    """
    config, options = config or TrainConfig(), options or BudgetOptions()
    check_cluster(cluster, config.device)
    state = BudgetState(Path(output))
    folder = ModelFolder(output)
    with folder.for_run(resume=resume, overwrite=overwrite):
        if resume:
            state.load()
            config = as_decided(config, TrainConfig.from_json(state.values["config"]).to_json())
            state.check(config, options)
        scene = with_fitting_points(with_small_photos_in_memory(scene))
        if not resume:
            config = decide(scene, config).tell(progress)
            folder.clear()
            state.begin(config, options, scene_record(scene, folder.path))
        return _Search(scene, config, options, progress, state, folder, cluster).run()


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
        cluster: str | None = None,
    ) -> None:
        self.cluster = cluster
        self.scene, self.options = scene, options
        self.state, self.folder = state, folder
        self.split = hold_out(self.scene)
        self.renderer = Renderer(config.device)
        self.validation = Validation(self.renderer, self.split.test, config.background)
        self.config = config.replace(save_iterations=(), test_iterations=())
        self.steps = StepReports(progress, STEPS, config.iterations)
        self.trial = self.config.replace(
            iterations=max(config.iterations // TRIAL_PART, 1),
            densify_interval=max(config.density.densify_interval // TRIAL_PART, 1),
        )

    def run(self) -> Budgeted:
        """Run the missing stages."""
        values = self.state.values
        if self.cluster is not None:
            self.train_on_workers(self.cluster)
        stages = {
            "rounds": self.try_out,
            "chosen": self.remove_splats,
            "thresholds": self.find_parts,
            "all_views": self.train_all,
        }
        for key, stage in stages.items():
            if key not in values:
                stage()
        return self.finish()

    def train_on_workers(self, cluster: str) -> None:
        """Have workers make the runs of the trial and of all views at the same time, if they are not made yet."""
        runs = {"rounds": ("trial", self.split, self.trial), "all_views": ("whole", self.scene, self.config)}
        missing = [run for stage, run in runs.items() if stage not in self.state.values]
        if not missing:
            return
        place = marked(self.state.folder)
        jobs = [
            Job(name, train_in_place, (TrainJob(SceneSource.of(scene), config, place / name),))
            for name, scene, config in missing
        ]
        self.steps.tell(1, f"{' and '.join(job.name for job in jobs)}: on workers")
        try:
            with WorkerPool(cluster, self.config.device) as pool:
                for _ in pool.successes(jobs):
                    pass
        finally:
            unmark(place)

    def try_out(self) -> None:
        """Make a run of half the length with all splats, without the validation views."""
        start = time.perf_counter()
        self.steps.tell(
            1,
            f"a run of {self.trial.iterations} iterations with at most {self.trial.cap_max} splats, "
            f"{len(self.split.train)} training views and {len(self.split.test)} validation views",
        )
        splats = self.trained("trial", self.split, self.trial)
        self.state.save("trial_0", splats)
        self.state.put("rounds", [self.row(splats, start)])

    def remove_splats(self) -> None:
        """Run rounds that remove splats."""
        rows: list[ModelRow] = self.state.values["rounds"]
        while not rounds_are_over(rows, self.options):
            start = time.perf_counter()
            splats = self.round("trial", len(rows), self.split, self.trial)
            rows = [*rows, self.row(splats, start)]
            self.state.put("rounds", rows)
        self.state.put("chosen", chosen_of(rows, self.options))

    def find_parts(self) -> None:
        """Find the fields and bands that the validation views do not need."""
        values, start = self.state.values, time.perf_counter()
        row = values["rounds"][values["chosen"]]
        self.steps.tell(3, f"parts of {row['splats']} splats that no view needs")
        allowed = PARTS_SHARE * self.options.tolerance
        if self.options.target_psnr is not None:
            allowed = max(row["psnr"] - self.options.target_psnr, 0.0)
        splats = self.state.model(f"trial_{values['chosen']}")
        found = prune(splats, self.split.train, self.validation, allowed, ("fields", "bands"), self.config.seed)
        small = found.splats
        if self.options.max_bytes is not None:
            small = self.fitted(small, self.split) or small
        self.state.put(
            "held_out",
            {
                "psnr": row["psnr"],
                "psnr_pruned": self.validation.psnr(small),
                "costs": found.costs,
                "seconds": round(time.perf_counter() - start, 2),
                **complexity(small).to_json(),
            },
        )
        self.state.put("thresholds", {"fields": found.thresholds.fields, "bands": found.thresholds.bands})

    def train_all(self) -> None:
        """Make a whole run with all training views."""
        start = time.perf_counter()
        self.steps.tell(4, f"all {len(self.scene.train)} training views, at most {self.config.cap_max} splats")
        splats = self.trained("whole", self.scene, self.config)
        self.state.save("whole_0", splats)
        seconds = round(time.perf_counter() - start, 2)
        self.state.put("all_views", [{"splats": len(splats), "seconds": seconds}])

    def finish(self) -> Budgeted:
        """Repeat the rounds and the removal of parts on the model of all views, and write its file."""
        values = self.state.values
        rows: list[ModelRow] = values["all_views"]
        while len(rows) <= values["chosen"] or self.is_too_large(rows):
            start = time.perf_counter()
            splats = self.round("whole", len(rows), self.scene, self.config)
            rows = [*rows, {"splats": len(splats), "seconds": round(time.perf_counter() - start, 2)}]
            self.state.put("all_views", rows)
        start = time.perf_counter()
        splats, found = self.state.model(f"whole_{len(rows) - 1}"), values["thresholds"]
        splats = apply_thresholds(
            splats,
            self.scene.train,
            self.renderer,
            Thresholds(0.0, found["fields"], found["bands"]),
            self.config.background,
            self.config.seed,
        )
        if self.options.max_bytes is not None:
            splats = self.fitted(splats, self.scene) or splats
        path = self.write(splats)
        size = path.stat().st_size
        self.state.put(
            "final",
            complexity(splats).to_json()
            | {"bytes": size, "missed": self.missed(size), "seconds": round(time.perf_counter() - start, 2)},
        )
        self.state.end()
        return Budgeted(splats, path, values)

    def is_too_large(self, rows: list[ModelRow]) -> bool:
        """Whether the model of all views has more splats than the limit of bytes allows."""
        if self.options.max_bytes is None or rows[-1]["splats"] <= MIN_SPLATS:
            return False
        return self.fitted(self.state.model(f"whole_{len(rows) - 1}"), self.scene) is None

    def write(self, splats: Splats) -> Path:
        """Write the files of the model's folder, and return the point cloud's."""
        folder, rounds = self.folder, len(self.state.values["all_views"]) - 1
        folder.write_run(self.state.values["config"], self.scene)
        folder.write_views([*self.scene.test, *self.scene.train])
        last = _run_name("whole", rounds, len(ROUND) - 1) if rounds else "whole"
        log = self.state.run_folder("whole").log_path
        if log.is_file():
            log.replace(folder.log_path)
        copy_exposures(self.state.run_folder(last), folder.exposures_path)
        path = folder.ply_path(self.config.iterations + rounds * sum(part.iterations(self.config) for part in ROUND))
        splats.save(path, compact=True)
        return path

    def round(self, run: str, number: int, scene: Scene, config: TrainConfig) -> Splats:
        """Remove a quarter of the splats that the round before left, train the others on, and keep the model.

        Parameters
        ----------
        run : "trial" or "whole". number : of the round, from 1. scene, config : as of the run.
        """
        splats = without_quarter(
            self.state.model(f"{run}_{number - 1}"),
            scene.train,
            self.renderer,
            config.background,
            config.seed,
            MIN_SPLATS,
        )
        self.steps.tell(2 if run == "trial" else 4, f"round {number}: {len(splats)} splats")
        before = _run_name(run, number - 1, len(ROUND) - 1) if number > 1 else run
        for step, part in enumerate(ROUND):
            name = _run_name(run, number, step)
            start = self.state.save(f"{name}_start", splats)
            copy_exposures(self.state.run_folder(before), exposures_beside(start))
            before = name
            splats = self.trained(name, scene, fine_tuning(config, splats, part, start))
        self.state.save(f"{run}_{number}", splats)
        return splats

    def trained(self, name: str, scene: Scene, config: TrainConfig) -> Splats:
        """Train in a folder of the search, from the stage's checkpoint if there is one."""
        folder = self.state.run_folder(name)
        resume = holds_run(folder, config)
        report = without_messages(self.steps.progress)
        model = train(scene, config, report, output=folder.path, resume=resume, overwrite=not resume)
        if not model.finished:
            raise KeyboardInterrupt
        return model.splats

    def row(self, splats: Splats, start: float) -> ModelRow:
        """Return the row of a model whose stage began at `start`; with a limit of bytes also its PSNR once it fits."""
        views = self.validation.per_view(splats)
        row: ModelRow = {"splats": len(splats), "psnr": statistics.fmean(views), "views": views}
        if self.options.max_bytes is not None:
            fitted = self.fitted(splats, self.split)
            row |= {"fitted_psnr": None if fitted is None else self.validation.psnr(fitted)}
        return row | {"seconds": round(time.perf_counter() - start, 2)}

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


def _run_name(run: str, number: int, step: int) -> str:
    """Return the name of the folder of a part of a round."""
    return f"{run}_{number}_{step}"
