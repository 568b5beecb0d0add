"""Arguments that name a model or its scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from clsplat.models.model import SceneChoice


def one_model(model: Path | None, model_path: Path | None) -> Path:
    """Return the model given as an argument or with -m; raise click.UsageError unless there is exactly one."""
    path = model or model_path
    if path is None or (model and model_path and model != model_path):
        raise click.UsageError("give one model folder or file of splats")
    return path


def scene_choice(values: dict[str, Any]) -> SceneChoice:
    """Take the options -s, -i, -r and, if the command has it, --allow-changed-photos out of `values`."""
    return SceneChoice(
        values.pop("source_path"),
        values.pop("images"),
        values.pop("resolution"),
        allow_changed_photos=values.pop("allow_changed_photos", False),
    )
