"""Rendering of many views into files, one view at a time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..cameras.cameras_json import NamedCamera
from ..cameras.path import DEFAULT_FPS
from ..errors import check_choice
from ..splats.color import BLACK, Color
from ..splats.splats import Splats
from .colormaps import depth_range
from .outputs import EXTRAS, FORMATS, ImageWriter, VideoFiles, extra_video, image_file, output_stems
from .renderer import RendersSplats

_QUARTILES = (0.25, 0.75)  # quantiles over the frames of the near and of the far end
_SAMPLES = 12  # frames that the range of depths is taken from, at a quarter of the size

# Called with the number of a view, from 1, as its work begins, and with the number of all views.
ViewProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class RenderOutput:
    """Files to write of each view.

    Parameters
    ----------
    folder : of the images; None writes no images.
    video : file of the video; None writes no video.
    format : of the images, "png" (8 bits, rounded) or "npy" (float32 as rendered).
    extras : any of "alpha" and "depth", which get files or videos of their own.
    depth_colours : write mean depth as a colour picture instead of 16 bits of grey.
    depth_range : depths at the two ends of the colours [world units]; None takes those seen along the views.
    fps : frames a second of the video; None takes those of the camera path, or DEFAULT_FPS.
    """

    folder: str | Path | None = None
    video: str | Path | None = None
    format: str = "png"
    extras: tuple[str, ...] = ()
    depth_colours: bool = False
    depth_range: tuple[float, float] | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        check_choice("format", self.format, FORMATS)
        for extra in self.extras:
            check_choice("extras", extra, EXTRAS)


@dataclass(frozen=True)
class RenderedViews:
    """The result of `render_to_files`.

    Attributes
    ----------
    render_ms : median wall time of a render after the first [ms].
    depth_scales : by the path of a grey depth PNG within the folder, the depth of its brightest value, 65535 [world
        units].
    """

    render_ms: float
    depth_scales: dict[str, float] = field(default_factory=dict)


def files_of(output: RenderOutput, names: Sequence[str]) -> list[Path]:
    """Return all files that `render_to_files` writes for views of these names. Raises InputError as `output_stems`."""
    files: list[Path] = []
    if output.folder is not None:
        folder, endings = Path(output.folder), ("", *(f"_{extra}" for extra in output.extras))
        stems = output_stems(names, output.extras, keep_suffix=output.format == "npy")
        files += [image_file(folder, stem, ending, output.format) for stem in stems for ending in endings]
    if output.video is not None:
        files += [Path(output.video), *(extra_video(output.video, extra) for extra in output.extras)]
    return files


def render_to_files(
    renderer: RendersSplats,
    splats: Splats,
    views: Sequence[NamedCamera],
    output: RenderOutput,
    background: Color = BLACK,
    progress: ViewProgress | None = None,
) -> RenderedViews:
    """Render all views and write their files.

    Parameters
    ----------
    views : at least one; their names give the names of the files.

    Raises
    ------
    InputError : two views have the same file, or a file would lie outside the folder.
    OutputError : a file cannot be written.
    """
    stems = output_stems([view.name for view in views], output.extras, keep_suffix=output.format == "npy")
    near_far = output.depth_range
    if "depth" in output.extras and (output.depth_colours or output.video is not None) and near_far is None:
        near_far = depths_seen(renderer, splats, views)
    times: list[float] = []
    scales: dict[str, float] = {}
    with ExitStack() as files:
        writers: list[ImageWriter | VideoFiles] = []
        if output.folder is not None:
            coloured = near_far if output.depth_colours else None
            images = ImageWriter(Path(output.folder), output.format, output.extras, coloured, background)
            writers.append(images)
            scales = images.depth_scales
        if output.video is not None:
            video = VideoFiles(Path(output.video), output.fps or DEFAULT_FPS, output.extras, near_far, background)
            writers.append(files.enter_context(video))
        for number, (stem, view) in enumerate(zip(stems, views, strict=True), 1):
            if progress is not None:
                progress(number, len(views))
            start = time.perf_counter()
            image = renderer.render(splats, view.camera, background)
            times.append(time.perf_counter() - start)
            for writer in writers:
                writer.write(stem, image)
    # The first render builds the kernels and uploads the splats.
    return RenderedViews(1e3 * statistics.median(times[1:] or times), scales)


def depths_seen(renderer: RendersSplats, splats: Splats, views: Sequence[NamedCamera]) -> tuple[float, float]:
    """Depths at the two ends of the colours, from a few small frames.

    All views get one range, so that the colours of a video do not flicker.
    """
    step = -(-len(views) // _SAMPLES)
    ranges = []
    for view in views[::step]:
        camera = view.camera
        small = camera.resized(max(1, camera.width // 4), max(1, camera.height // 4))
        ranges.append(depth_range(renderer.render(splats, small)))
    near, far = np.quantile(ranges, _QUARTILES, axis=0).diagonal()  # a frame inside a wall does not stretch the range
    return float(near), float(far)
