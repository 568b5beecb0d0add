"""Resumed runs: a check of their options, and longer runs that do not fall behind what the shorter run had reached."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..scenes.scene import View
from .checkpoint import Checkpoint, Reached
from .config import FREE_OPTIONS, TrainConfig
from .decisions import as_decided
from .folder import ModelFolder
from .schedules import RunSchedule, sh_degree_at
from .stored_run import moved_start
from .view_sampler import ViewSampler


def fitting_checkpoint(folder: ModelFolder, config: TrainConfig) -> Checkpoint:
    """Return the folder's checkpoint for a run with this config.

    Raises
    ------
    InputError : the run had other options. Only FREE_OPTIONS may change, and the number of iterations may rise. What
        the run decided by itself stays.
    """
    checkpoint = Checkpoint.load(folder.checkpoint_path)
    stored = TrainConfig.from_json(checkpoint.config).to_json()
    for key, value in as_decided(config, stored).to_json().items():
        if key in FREE_OPTIONS or stored[key] == value or moved_start(folder, key, value, stored[key]):
            continue
        remedy = "use the same options"
        if key == "iterations":
            if value > stored[key]:
                continue
            remedy = f"use a number above {stored[key]} to train longer"
        raise InputError(
            f"{folder.path}: --resume with {key}={value}, but the run was started with {key}={stored[key]}: {remedy}, "
            "or --overwrite to start again"
        )
    return checkpoint


def reached_by(checkpoint: Checkpoint, config: TrainConfig, views: list[View]) -> Reached | None:
    """Return the limits of the rest of a run. None if the run never became longer.

    Parameters
    ----------
    config : options of the rest of the run.
    views : training views.
    """
    before, stored = checkpoint.reached, TrainConfig.from_json(checkpoint.config)
    if config.iterations <= stored.iterations:
        return before
    iteration, n_splats = checkpoint.iteration, len(checkpoint.splats["mean"])
    interval = RunSchedule.create(stored, checkpoint.n_first).sh_interval
    degree = sh_degree_at(iteration, interval, stored.sh_degree)
    sampler = ViewSampler(views, stored.iterations, stored.schedule.coarse_to_fine, np.random.default_rng(0), [])
    downscale = sampler.downscale(iteration, n_splats)
    if before is not None:
        degree, downscale = max(degree, before.sh_degree), min(downscale, before.downscale)
    return Reached(degree, downscale)
