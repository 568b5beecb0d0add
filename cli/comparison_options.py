"""Options that `clsplat compare`, `frontier` and `benchmark` share: the grid of runs, and sections of their help."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import click

from clsplat.device.specs import count_devices
from clsplat.training.config import TrainConfig

from .options import PATH, Numbers

F = TypeVar("F", bound=Callable[..., Any])

cluster_option = click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Let workers do the runs: those of a scheduler (tcp://HOST:8786 or its file), or local:N on this machine.",
)


def check_device(device: str | None, cluster: str | None) -> None:
    """Refuse `--device` beside workers of other programs, which have devices of their own."""
    if device is not None and cluster is not None and not cluster.startswith("local"):
        raise click.UsageError("--device has no effect here: each worker has its own (clsplat worker --device)")


def check_devices_of_runs(device: str | None, cluster: str | None) -> None:
    """Refuse several devices, as each run of a comparison has one; and `--device` as `check_device` does."""
    check_device(device, cluster)
    if count_devices(device) > 1:
        raise click.UsageError("--device: each run has one device: name one, or give --cluster local:N")


def comparison_sections(*others: str) -> dict[str, tuple[str, ...]]:
    """Return the sections of a command's help. others : names of the common options that only this command has."""
    grid = ("output", "systems", "caps", "seeds", "lengths", "resolution")
    return {
        "Common options": (*grid, *others, "cluster", "device", "quiet"),
        "Photos and test views": ("images", "masks", "alpha", "test_every", "test_list"),
    }


def grid_options(
    *,
    output: str,
    systems: Sequence[str],
    about_systems: str,
    caps: Sequence[int] | str,
    about_seeds: str = "",
    default_output: bool = False,
    also_systems: Sequence[str] = (),
    lengths: bool = True,
) -> Callable[[F], F]:
    """Add `--output`, `--systems`, `--cap-max`, `--iterations` (if `lengths`) and `--seeds`.

    Parameters
    ----------
    output, about_systems : help texts.
    systems, caps : defaults; a text says what the default caps are.
    about_seeds : more of the help text of `--seeds`.
    default_output : whether the command has a folder of its own if `--output` is left out.
    also_systems : other names of `--systems`.
    lengths : whether `--iterations` is a list. Leave the training option of this name out then.
    """
    shown = caps if isinstance(caps, str) else ",".join(map(str, caps))
    options = [
        click.option("-o", "--output", required=not default_output, type=PATH, metavar="DIR", help=output),
        click.option(
            "--systems",
            *also_systems,
            "systems",
            default=",".join(systems),
            show_default=True,
            metavar="NAME,NAME,...",
            help=about_systems,
        ),
        click.option(
            "--cap-max",
            "caps",
            type=Numbers("caps"),
            multiple=True,
            help=f"Caps on the splats: a run for each.  [default: {shown}]",
        ),
        click.option(
            "--seeds",
            type=Numbers("seeds", 0),
            multiple=True,
            help=f"Seeds: a run for each.{about_seeds}  [default: 0]",
        ),
    ]

    if lengths:
        options.append(
            click.option(
                "--iterations",
                "--steps",
                "lengths",
                type=Numbers("iterations"),
                multiple=True,
                help=f"Numbers of iterations: a run for each.  [default: {TrainConfig().iterations}]",
            )
        )

    def add(function: F) -> F:
        for option in reversed(options):
            function = option(function)
        return function

    return add
