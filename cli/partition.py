"""`clsplat partition`: divide a large scene into blocks, and look at them before they are trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from clsplat.errors import InputError
from clsplat.scenes.options import READING_OPTIONS
from clsplat.training.config import TrainConfig
from clsplat.training.stored_run import load_recorded_scene

from .blocks import blocks_options, given_blocks, partition_table, report_interruption, warn_of_single_model
from .options import (
    PATH,
    TrainingCommand,
    config_options,
    config_values,
    hiding_options,
    is_given,
    overwrite_option,
    photo_options,
    quiet_option,
    split_options,
)
from .progress import TrainingDisplay, resume_command


@click.command(
    "partition",
    cls=TrainingCommand,
    sections={
        "Common options": (
            "model_path",
            "blocks",
            "polish",
            "iterations",
            "cap_max",
            "resolution",
            "overwrite",
            "device",
            "quiet",
        ),
        "Photos and test views": ("images", "masks", "alpha", "eval", "test_every", "test_list"),
    },
    examples=(
        ("clsplat partition SCENE -m MODEL --blocks 2x2", "Four blocks: a table, and MODEL/partition.svg."),
        ("clsplat train --resume -m MODEL", "Train them."),
    ),
    see_also=("train", "worker"),
)
@click.argument("scene", type=PATH)
@click.option("-m", "--model-path", type=PATH, required=True, help="Folder of the model.")
@blocks_options
@photo_options
@hiding_options
@click.option("--eval", is_flag=True, help="Hold test views out of training.")
@split_options("; implies --eval")
@overwrite_option("the model that is there")
@quiet_option
@config_options()
@click.pass_context
def partition(
    ctx: click.Context, /, scene: Path, model_path: Path, overwrite: bool, quiet: bool, **values: Any
) -> None:
    """Divide a large SCENE into blocks, and print their splats, points and photos.

    The command trains a coarse model of the whole scene. Blocks fill equal parts of the photos. A photo belongs to each
    block that fills at least 2 % of it. MODEL/partition.svg shows cells, points and cameras from above.

    `clsplat train --resume` goes on from there.
    """
    from clsplat.blocks.train import PICTURE, partition_scene

    blocks = given_blocks(values)
    if blocks is None:
        raise InputError("name the blocks: --blocks 2x2")
    config = TrainConfig(**config_values(ctx, values))
    options = blocks(config)
    warn_of_single_model(config, "--blocks")
    reading = {key: values[key] for key in READING_OPTIONS if is_given(ctx, key)}
    loaded = load_recorded_scene(scene, reading, config.background)
    try:
        with TrainingDisplay(quiet) as display:
            found = partition_scene(loaded, options, config, display, output=model_path, overwrite=overwrite)
    except KeyboardInterrupt:
        report_interruption(ctx, model_path)
    if not quiet:
        click.echo(partition_table(found))
        click.echo(f"{model_path / PICTURE}: the blocks from above; to train them: {resume_command(model_path)}")
