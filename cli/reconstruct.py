"""`clsplat reconstruct`: photographs or a video become a scene. Also what `train` does with photos without poses."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from clsplat.errors import OutputError
from clsplat.scenes.reconstruct.options import CAMERA_MODELS, CAMERA_MODES, MATCHERS, ReconstructOptions
from clsplat.training.progress import PLAIN_INTERVAL, LiveLine

from .options import PATH, overwrite_option, quiet_option
from .progress import duration

if TYPE_CHECKING:
    from clsplat.scenes.reconstruct.reconstruct import ReconstructionResult
    from clsplat.scenes.reconstruct.sfm_process import Step

_DEFAULTS = ReconstructOptions()


@click.command("reconstruct")
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
    help="Which photos share a lens; auto: those of one size, camera and focal length.",
)
@click.option(
    "--matcher",
    type=click.Choice(MATCHERS),
    default=_DEFAULTS.matcher,
    show_default=True,
    help="Which photos are compared: all pairs, or neighbours by name (auto: videos, more than 150 photos).",
)
@click.option(
    "--max-size",
    type=click.IntRange(min=64),
    default=_DEFAULTS.max_size,
    show_default=True,
    metavar="PX",
    help="Longest side at which features are looked for; the scene keeps the photos' size.",
)
@click.option(
    "--frames",
    type=click.IntRange(min=3),
    default=_DEFAULTS.frames,
    show_default=True,
    metavar="N",
    help="Of a video: the sharpest frame of each of N equal stretches.",
)
@click.option("--seed", type=click.IntRange(min=0), default=_DEFAULTS.seed, show_default=True)
@overwrite_option
@quiet_option
def reconstruct_scene(photos: Path, scene: Path, overwrite: bool, quiet: bool, **values: Any) -> None:
    """Make a scene to train on of PHOTOS, a folder of photographs or a video.

    COLMAP's library finds the poses; SCENE gets images/ (upright, without lens distortion), sparse/0/ and
    reconstruct.json. Folders below PHOTOS belong to it. Masks, black where a photo does not count, lie in PHOTOS/masks
    as NAME.png or NAME.jpg.png.
    """
    result = run_reconstruction(photos, scene, ReconstructOptions(**values), overwrite, quiet)
    if not quiet:
        report(result)
        click.echo(f"next: clsplat train {result.scene}")


def run_reconstruction(
    photos: Path, scene: Path, options: ReconstructOptions, overwrite: bool, quiet: bool
) -> ReconstructionResult:
    """Reconstruct with a live display."""
    from clsplat.scenes.reconstruct.reconstruct import reconstruct

    with StepDisplay(quiet) as display:
        return reconstruct(photos, scene, options, display, overwrite)


def report(result: ReconstructionResult) -> None:
    """Say what came of it."""
    click.echo(
        f"{result.scene}: {result.registered} of {result.photos} photos placed, {result.points} points seen by "
        f"{result.track_length:.1f} photos each, {result.error:.2f} px off, in {duration(result.seconds)}"
    )


def scene_of_photos(photos: Path, model: Path, overwrite: bool, quiet: bool) -> Path:
    """The scene to train on for photographs without poses: beside the model, made when it is not there yet.

    Raises
    ------
    OutputError : the scene that is there was made of other photos. Others as `reconstruct`.
    """
    from clsplat.scenes.reconstruct.photo_files import find_photos, is_video
    from clsplat.scenes.reconstruct.reconstruct import estimate_seconds, is_made_from

    scene = model.parent / f"{photos.resolve().stem if is_video(photos) else photos.resolve().name}-scene"
    options = ReconstructOptions()
    made = is_made_from(scene, photos)
    if made:
        if not quiet:
            click.echo(f"{photos}: no poses: {scene} was reconstructed of it before and is used", err=True)
        return scene
    if made is False and not overwrite:
        raise OutputError(
            f"{scene}: was reconstructed of other photos than {photos} now has: use --overwrite to make "
            f"it anew, or clsplat reconstruct {photos} -o OTHER and train on that"
        )
    if not quiet:
        what = f"{options.frames} frames"
        if not is_video(photos):
            found = find_photos(photos)
            what = f"{len(found)} photos, {_minutes(estimate_seconds(found, options))}"
        click.echo(f"{photos}: no poses: reconstructing {scene} first ({what})", err=True)
    result = run_reconstruction(photos, scene, options, overwrite, quiet)
    if not quiet:
        report(result)
    return scene


def _minutes(seconds: float) -> str:
    """Roughly: an estimate is no better."""
    return "about a minute" if seconds < 90 else f"about {round(seconds / 60)} min"


class StepDisplay:
    """Shows Steps: a line for each kind of work, rewritten on a terminal.

    Parameters
    ----------
    quiet : show nothing.
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
        # What is done within the interval needs one line in a log.
        if last or self._line.live or self._line.clock() - self._begun >= PLAIN_INTERVAL:
            self._line.show(f"{step.label} {step.done}" + (f"/{step.total}" if step.total else ""), last)
