"""The result of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..evaluation.evaluate import Evaluation
from ..splats.splats import Splats
from .config import TrainConfig


@dataclass(frozen=True)
class Model:
    """A trained model.

    Attributes
    ----------
    iteration : iterations done; fewer than the config's if the run was interrupted.
    seconds : training time, without evaluations.
    peak_bytes : peak of the host memory. On a CPU device it includes the device memory.
    device_bytes : memory of the pools of buffers.
    evaluations : metrics of the test views by iteration, for the config's `test_iterations` since the last resume.
    evaluation_seconds : training time before each evaluation.
    path : the model folder, or None.
    best_iteration : iteration that was best on the validation views; 0 without the option `validate`.
    left_out : names of training views that the run left out because they disagree with all others.
    n_context : number of splats that the run did not change (training/context.py), the last ones.
    """

    splats: Splats
    config: TrainConfig
    iteration: int
    seconds: float
    peak_bytes: int
    device_bytes: int
    evaluations: dict[int, Evaluation] = field(default_factory=dict)
    evaluation_seconds: dict[int, float] = field(default_factory=dict)
    path: Path | None = None
    best_iteration: int = 0
    left_out: tuple[str, ...] = ()
    n_context: int = 0

    @property
    def finished(self) -> bool:
        """Whether all iterations are done."""
        return self.iteration >= self.config.iterations
