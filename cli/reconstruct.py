"""`clsplat reconstruct`: make a scene from photos or a video. `train` does the same for photos without poses."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from clsplat.scenes.reconstruct.options import (
    CAMERA_MODELS,
    CAMERA_MODES,
    MATCHERS,
    PANORAMAS,
    RANGES,
    ReconstructOptions,
)
from clsplat.training.live_line import PLAIN_INTERVAL, LiveLine

from .command import DocumentedCommand
from .options import PATH, overwrite_option, quiet_option
from .progress import duration

if TYPE_CHECKING:
    from clsplat.scenes.reconstruct.reconstruct import ReconstructionResult
    from clsplat.scenes.reconstruct.sfm_process import Step

_DEFAULTS = ReconstructOptions()


@click.command(
    "reconstruct",
    cls=DocumentedCommand,
    examples=(
        ("clsplat reconstruct PHOTOS -o SCENE", "Find the poses of a folder of photos."),
        ("clsplat reconstruct VIDEO.mp4 -o SCENE --frames 200", "Take 200 sharp frames of a video."),
    ),
    see_also=("info", "train"),
)
@click.argument("photos", type=PATH)
@click.option("-o", "--output", "scene", type=PATH, required=True, metavar="SCENE", help="Folder of the scene.")
@click.option(
    "--camera-model",
    type=click.Choice(CAMERA_MODELS, case_sensitive=False),
    default=_DEFAULTS.camera_model,
    show_default=True,
    metavar="NAME",
    help="COLMAP's name of the lens model: OPENCV for wide lenses, OPENCV_FISHEYE for fisheyes.",
)
@click.option(
    "--camera-mode",
    type=click.Choice(CAMERA_MODES),
    default=_DEFAULTS.camera_mode,
    show_default=True,
    help="Which photos share a lens. auto: photos of equal size, camera and focal length.",
)
@click.option(
    "--matcher",
    type=click.Choice(MATCHERS),
    default=_DEFAULTS.matcher,
    show_default=True,
    help="Which photos are compared: all pairs, or neighbours by name (auto: for videos and more than 150 photos).",
)
@click.option(
    "--max-size",
    type=click.IntRange(*RANGES["max_size"]),
    default=_DEFAULTS.max_size,
    show_default=True,
    metavar="PX",
    help="Photos are reduced to this longest side to find features; the scene keeps their size.",
)
@click.option(
    "--frames",
    type=click.IntRange(*RANGES["frames"]),
    default=_DEFAULTS.frames,
    show_default=True,
    metavar="N",
    help="Number of frames to take from a video: the sharpest frame of each of N equal parts.",
)
@click.option(
    "--panoramas",
    type=click.Choice(PANORAMAS),
    default=_DEFAULTS.panoramas,
    show_default=True,
    help="Cut equirectangular photos into pinhole photos. auto: if they say that they are panoramas; a video does not.",
)
@click.option(
    "--seed",
    type=click.IntRange(*RANGES["seed"]),
    default=_DEFAULTS.seed,
    show_default=True,
    metavar="N",
    help="Seed of all random numbers.",
)
@overwrite_option("the scene that is there")
@quiet_option
def reconstruct_scene(photos: Path, scene: Path, overwrite: bool, quiet: bool, **values: Any) -> None:
    """Make a scene for training from PHOTOS, a folder of photos or a video.

    COLMAP's library finds the poses. SCENE gets images/ (upright and undistorted), sparse/0/ and reconstruct.json.
    Subfolders of PHOTOS are included. Masks are in PHOTOS/masks as NAME.png or NAME.jpg.png; black pixels of a mask do
    not count.
    """
    result = run_reconstruction(photos, scene, ReconstructOptions(**values), overwrite, quiet)
    if not quiet:
        report(result)
        click.echo(f"next: clsplat train {result.scene}")


def run_reconstruction(
    photos: Path, scene: Path, options: ReconstructOptions, overwrite: bool, quiet: bool
) -> ReconstructionResult:
    """Reconstruct a scene with a live display, and return the result."""
    from clsplat.scenes.reconstruct.reconstruct import reconstruct

    with StepDisplay(quiet) as display:
        return reconstruct(photos, scene, options, display, overwrite)


def report(result: ReconstructionResult) -> None:
    """Print the result of a reconstruction."""
    click.echo(
        f"{result.scene}: {result.registered} of {result.photos} photos placed, {result.points} points seen by "
        f"{result.track_length:.1f} photos each, {result.error:.2f} px off, in {duration(result.seconds)}"
    )


def scene_of_photos(photos: Path, model: Path, overwrite: bool, quiet: bool, recorded: Path | None = None) -> Path:
    """Return the scene of photographs without poses. Reconstruct it if it does not exist.

    `recorded` is the scene of a run that is resumed.
    """
    from clsplat.scenes.reconstruct.model_scene import plan_scene

    options = ReconstructOptions()
    scene = plan_scene(photos, model, options, overwrite, recorded)
    if scene.exists:
        if not quiet:
            click.echo(f"{photos}: no poses: {scene.path} was reconstructed from it before and is used", err=True)
        return scene.path
    if not quiet:
        work = f"{scene.photos} frames"
        if scene.seconds is not None:
            work = f"{scene.photos} photos, {_minutes(scene.seconds)}"
        click.echo(f"{photos}: no poses: reconstructing {scene.path} first ({work})", err=True)
    result = run_reconstruction(photos, scene.path, options, overwrite, quiet)
    if not quiet:
        report(result)
    return scene.path


def _minutes(seconds: float) -> str:
    """Return an estimated duration as text, in whole minutes."""
    return "about a minute" if seconds < 90 else f"about {round(seconds / 60)} min"


class StepDisplay:
    """A display of the steps of a reconstruction: one line per kind of work, updated on a terminal.

    Parameters
    ----------
    quiet : whether to show no output.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self._line = LiveLine()
        self._label, self._begun = "", 0.0

    def __enter__(self) -> StepDisplay:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._line.close()

    def __call__(self, step: Step) -> None:
        if self.quiet:
            return
        if step.label != self._label:
            self._line.close()
            self._line, self._label = LiveLine(), step.label
            self._begun = self._line.clock()
        last = step.done == step.total
        # In a log, work that takes less time than the interval gets a single line.
        if last or self._line.live or self._line.clock() - self._begun >= PLAIN_INTERVAL:
            self._line.show(f"{step.label} {step.done}" + (f"/{step.total}" if step.total else ""), last)
