"""Measurements of one model, and the recorder of LPIPS, FLIP and images of its views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError
from ..evaluation.floaters import FloaterMeasures
from ..evaluation.metrics import color_corrected
from ..evaluation.perceptual import Flip, Lpips
from ..evaluation.report.images import ComparedImage, compare_images
from ..rendering.renderer import Rendered
from ..scenes.scene import Scene, View
from .model import LoadedModel


@dataclass(frozen=True)
class ModelEvaluation:
    """Measurements of one model.

    Attributes
    ----------
    model : the model that was measured. scene : the scene of the views.
    result : the entry of results.json: means of the metrics, render time, bytes, complexity and protocol.
    per_view : values by metric and view.
    images : images for a report by view; empty without a report.
    report : file of the model's report, if one was written.
    write_error : reason why results.json or per_view.json could not be written; None if they were written.
    """

    model: LoadedModel
    scene: Scene
    result: dict[str, Any]
    per_view: Mapping[str, Mapping[str, float]]
    images: Mapping[str, ComparedImage]
    report: Path | None = None
    write_error: OutputError | None = None

    @property
    def psnr(self) -> float:
        """Mean PSNR [dB]."""
        return float(self.result["PSNR"])

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return float(self.result["SSIM"])

    @property
    def view_sizes(self) -> dict[str, tuple[int, int]]:
        """(width, height) [px] of the measured views by name."""
        cameras = {view.name: view.camera for view in self.scene.views}
        return {name: (cameras[name].width, cameras[name].height) for name in self.per_view["PSNR"]}

    @property
    def floaters(self) -> FloaterMeasures | None:
        """Measures of floaters on the training views; None without training views."""
        stored = self.result.get("floaters")
        return None if stored is None else FloaterMeasures(**{"psnr_gap": None, **stored})


@dataclass
class ViewRecorder:
    """A callback for each view and its render that measures LPIPS and FLIP, and keeps the images of the report.

    Parameters
    ----------
    lpips, flip : functions of the metrics; None if the metric is not measured.
    report : whether to keep images.
    corrected : whether to adapt the exposure of renders to that of their photos.

    Attributes
    ----------
    per_view : values by metric and view.
    images : images by view.
    """

    lpips: Lpips | None = None
    flip: Flip | None = None
    report: bool = True
    corrected: bool = False
    per_view: dict[str, dict[str, float]] = field(default_factory=dict)
    images: dict[str, ComparedImage] = field(default_factory=dict)

    def __call__(self, view: View, image: Rendered) -> None:
        color: NDArray[Any] = image.color
        if self.corrected:
            color = color_corrected(np.clip(color, 0, 1), view.image / np.float32(255), view.mask)
        flip_map = None
        if self.lpips is not None:
            self.per_view.setdefault("LPIPS", {})[view.name] = self.lpips(color, view.image, view.mask)
        if self.flip is not None:
            flip_map = self.flip(color, view.image, view.mask)
            self.per_view.setdefault("FLIP", {})[view.name] = self.flip.mean(flip_map, view.mask)
        if self.report:
            self.images[view.name] = compare_images(view.image, color, view.mask, flip_map)

    def describe(self) -> dict[str, str]:
        """Return texts on how LPIPS and FLIP are computed; empty if neither is measured."""
        metrics = (("LPIPS", self.lpips), ("FLIP", self.flip))
        return {name: metric.describe() for name, metric in metrics if metric is not None}
