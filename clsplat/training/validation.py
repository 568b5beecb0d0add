"""Validation views of a run: their metrics along the run, and the model that was best on them.

The best model is never chosen on test views: a figure of the views that chose it would be too good.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

from ..evaluation.evaluate import evaluate
from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.splats import Splats
from .config import TrainConfig
from .folder import ModelFolder
from .log import RunLog

MEASUREMENTS = 20  # in a run, at equal distances


@dataclass(frozen=True)
class Measurement:
    """A measurement. iteration : 0 before the first one. psnr : of the validation views [dB]."""

    iteration: int = 0
    psnr: float = -math.inf


class RunValidation:
    """Measures the validation views, and keeps the point cloud of the best iteration.

    Parameters
    ----------
    views : validation views; without any, nothing is ever due.
    after_end : whether the run makes a finished one longer. Then the best point cloud of that run stays.
    """

    def __init__(self, renderer: Renderer, views: list[View], config: TrainConfig, after_end: bool = False) -> None:
        self.renderer, self.views, self.background = renderer, views, config.background
        self.iterations, self.after_end = config.iterations, after_end
        self.kept = {*config.output.save_iterations, config.iterations}
        self.best = self.last = Measurement()

    def is_due(self, iteration: int) -> bool:
        """Return whether the views are measured after an iteration (from 1). The last one is always measured."""
        every = max(self.iterations // MEASUREMENTS, 1)
        return bool(self.views) and (iteration % every == 0 or iteration == self.iterations)

    def resume(self, folder: ModelFolder, iteration: int) -> None:
        """Continue after an iteration: the best measurement is that of the log whose point cloud is still there."""
        stored = set(folder.iterations())
        for measured in _logged(folder, iteration):
            self.last = measured
            if measured.psnr > self.best.psnr and measured.iteration in stored:
                self.best = measured
        if self.after_end:
            self.kept.add(self.best.iteration)

    def measure(self, splats: Splats, iteration: int, seconds: float, log: RunLog, folder: ModelFolder | None) -> None:
        """Measure the splats of an iteration. The best point cloud so far replaces the one before.

        Parameters
        ----------
        seconds : training time so far.
        folder : receives the point clouds; None keeps no file.
        """
        measured = evaluate(self.renderer, splats, self.views, self.background)
        self.last = Measurement(iteration, measured.psnr)
        if measured.psnr > self.best.psnr:
            before, self.best = self.best, self.last
            if folder is not None:
                folder.save(splats, iteration)
                if before.iteration and before.iteration not in self.kept:
                    folder.remove_ply(before.iteration)
        log.write(
            {
                "iteration": iteration,
                "seconds": seconds,
                "validation_psnr": measured.psnr,
                "validation_ssim": measured.ssim,
                "splats": len(splats),
            }
        )

    def summary(self, folder: ModelFolder | None) -> str:
        """Return a sentence for the end of the run."""
        end = f"{len(self.views)} validation views: PSNR {self.last.psnr:.2f} dB at the end"
        if self.best.iteration == self.last.iteration:
            return f"{end}, the best of the run"
        best = f"{end}; {self.best.psnr:.2f} dB after iteration {self.best.iteration} was the best"
        return best if folder is None else f"{best}, and is kept in point_cloud/iteration_{self.best.iteration}"


def _logged(folder: ModelFolder, until: int) -> list[Measurement]:
    """Return the measurements in log.jsonl up to an iteration."""
    found = []
    for line in folder.log_path.read_bytes().splitlines() if folder.log_path.is_file() else ():
        try:
            values = json.loads(line)
            if values["iteration"] <= until:
                found.append(Measurement(int(values["iteration"]), float(values["validation_psnr"])))
        except (ValueError, KeyError, TypeError, RecursionError):
            continue  # another kind of line, or one that a crash cut off
    return found
