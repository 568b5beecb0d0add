"""Arguments that name a model or its scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.models.model import SceneChoice

if TYPE_CHECKING:
    from clsplat.models.convert import ConversionCost, ConvertedModel


def one_model(model: Path | None, model_path: Path | None) -> Path:
    """Return the model given as an argument or with -m; raise click.UsageError unless there is exactly one."""
    path = model or model_path
    if path is None or (model and model_path and model != model_path):
        raise click.UsageError("give one model folder or file of splats")
    return path


def missing_numbers(converted: ConvertedModel) -> list[str]:
    """Return a line for each number of the model that the file does not hold."""
    lines, splats = [], converted.splats
    if converted.lacks_near_plane:
        lines.append(f"the near plane is not in the file: splats nearer than {splats.near_plane:.4g} units are drawn")
    if converted.lacks_antialiasing:
        lines.append("the file does not say that its splats are antialiased: programs draw small splats too thick")
    elif converted.lacks_low_pass:
        lines.append(f"the low pass of {splats.low_pass:g} px² is not in the file: programs blur a little more")
    if converted.lacks_bands:
        lines.append("the SH bands above 0 are not in the file: colours are the same from all sides")
    return lines


def cost_line(cost: ConversionCost) -> str:
    """Return a line on how far the images of the file are from those of the model."""
    return f"PSNR against the model's own images, {cost.cameras} cameras: {cost.mean:.2f} dB, worst {cost.worst:.2f} dB"


def scene_choice(values: dict[str, Any]) -> SceneChoice:
    """Take the options -s, -i, -r and, if the command has it, --allow-changed-photos out of `values`."""
    return SceneChoice(
        values.pop("source_path"),
        values.pop("images"),
        values.pop("resolution"),
        allow_changed_photos=values.pop("allow_changed_photos", False),
    )
