"""What `clsplat eval` takes down of each view beside PSNR and SSIM, and the page it makes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat import __version__
from clsplat.errors import InputError, OutputError
from clsplat.evaluation.metrics import color_corrected
from clsplat.training.config import TrainConfig

from .models import LoadedModel

if TYPE_CHECKING:
    from clsplat.evaluation.perceptual import Flip, Lpips
    from clsplat.evaluation.report.images import ComparedImage
    from clsplat.rendering.renderer import Rendered
    from clsplat.scenes.scene import View

# Options whose values a page names first, whatever they are.
_ALWAYS = ("iterations", "cap_max", "seed")


@dataclass
class ViewRecorder:
    """Called with each view and its render: measures LPIPS and FLIP where given, and keeps what the page shows.

    Parameters
    ----------
    lpips, flip : metrics to take. pages : keep images for a page. corrected : renders in their photos' exposure.
    per_view : by metric, values by the views' names. shots : by the views' names.
    """

    lpips: Lpips | None = None
    flip: Flip | None = None
    pages: bool = True
    corrected: bool = False
    per_view: dict[str, dict[str, float]] = field(default_factory=dict)
    shots: dict[str, ComparedImage] = field(default_factory=dict)

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
        if self.pages:
            from clsplat.evaluation.report.images import shot_of

            self.shots[view.name] = shot_of(view.image, color, view.mask, flip_map)


@dataclass(frozen=True)
class Measurement:
    """Of one model: the entry of its results.json, values by metric and view, images for the page, and why the files
    could not be written, if so."""

    model: LoadedModel
    result: dict[str, Any]
    per_view: Mapping[str, Mapping[str, float]]
    shots: Mapping[str, ComparedImage]
    unwritten: OutputError | None = None


def write_model_page(path: Path, scene: str, measured: Sequence[Measurement], labels: Sequence[str]) -> Path:
    """The page of one model, or one that compares several; returns its path.

    Parameters
    ----------
    scene : its name. labels : of the models, one each.

    Raises
    ------
    InputError : the models were measured on different views. OutputError : cannot be written.
    """
    from clsplat.evaluation.report.page import Measured, write_eval_report

    first = measured[0].result
    what = f"{first['views']} {'' if first['set'] == 'all' else first['set'] + ' '}views of {scene}"
    models = [
        Measured(label, _costs(one), _facts(one), one.per_view, one.shots)
        for label, one in zip(labels, measured, strict=True)
    ]
    return write_eval_report(path, models, what, _protocol_lines(first))


def _protocol_lines(result: dict[str, Any]) -> list[str]:
    said = {key: text for key, text in result["protocol"].items() if key != "name"}
    lines = [
        f"Protocol {result['protocol']['name']}. "
        + ". ".join(f"{key}: {text}" for key, text in said.items())
        + ". Numbers of different protocols must not be compared. Render times are the median over the views."
    ]
    lines.append(f"On {result['device']}, by clsplat {__version__}, {date.today().isoformat()}.")
    return lines


def _costs(measured: Measurement) -> dict[str, str]:
    result = measured.result
    return {
        "splats": str(result["splats"]),
        "render [ms]": f"{result['render_ms']:.1f}",
        "MB": f"{result['bytes'] / 1e6:.2f}",
    }


def _facts(measured: Measurement) -> list[tuple[str, str]]:
    result, model = measured.result, measured.model
    facts = [
        ("file", str(model.ply)),
        (
            "shape",
            f"{result['shape']} ({result['normalisation']})" + (", antialiased" if model.splats.antialiased else ""),
        ),
        ("splats", f"{result['splats']}" + (f", {result['skewed']} of them skewed" if result["skewed"] else "")),
        ("SH degree", str(model.splats.sh_degree)),
        ("bytes", f"{result['bytes']} ({result['compact_bytes']} written compactly)"),
        ("background", ", ".join(f"{part:g}" for part in result["background"])),
    ]
    return facts + _options(model)


def _options(model: LoadedModel) -> list[tuple[str, str]]:
    """How it was trained, as far as its folder tells: the usual options, and those that are not the defaults."""
    if model.folder is None or not model.folder.config_path.is_file():
        return []
    try:
        config = TrainConfig.from_json(model.folder.read_config()["config"]).to_json()
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return []  # of 3DGS, or edited: the page does without
    usual = TrainConfig().to_json()
    told = {key: value for key, value in config.items() if key in _ALWAYS or value != usual.get(key)}
    return [("options", ", ".join(f"{key.replace('_', '-')} {value}" for key, value in told.items()))]
