"""Files of rendered views: images of colour, alpha and depth, and videos."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from types import TracebackType

import numpy as np

from ..errors import InputError
from ..files.atomic import atomic_writer
from ..files.file_names import RESERVED, name_key
from ..files.image_names import bare_name
from ..files.images import write_grey16, write_png
from ..files.video import VideoWriter
from ..splats.color import BLACK, Color
from .colormaps import depth_picture, picture_of
from .renderer import Rendered

FORMATS = ("png", "npy")
EXTRAS = ("alpha", "depth")
_FULL_SCALE = 65535


def output_stems(names: Sequence[str], extras: Sequence[str] = (), keep_suffix: bool = False) -> list[str]:
    """File names without suffix, one for each view. Folders in a view's name are kept.

    Parameters
    ----------
    names : of the views; they may come from foreign files.
    extras : any of EXTRAS, whose files lie beside the colours.
    keep_suffix : keep the extension of the image, so that an array's file is called `<img_name>.npy`.

    Raises
    ------
    InputError : a name would leave the output folder, or two views have the same file.
    """
    stems: list[str] = []
    view_of: dict[str, str] = {}
    for name in names:
        stem = _safe(name) if keep_suffix else bare_name(_safe(name))
        for file in (stem, *(f"{stem}_{extra}" for extra in extras)):
            key = name_key(file)
            if key in view_of:
                raise InputError(
                    f"views {view_of[key]!r} and {name!r} would both be written to {file}: rename one of them"
                )
            view_of[key] = name
        stems.append(stem)
    return stems


def _safe(name: str) -> str:
    """The name as a relative path with forward slashes."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
    absolute = name.startswith(("/", "\\")) or (bool(parts) and ":" in parts[0])
    if not parts or absolute or ".." in parts or "\0" in name:
        raise InputError(f"view {name!r}: its image would lie outside the output folder: rename it")
    if refused := RESERVED.intersection(name):
        raise InputError(f"view {name!r}: this system has no files with {min(refused)} in their name: rename it")
    return str(PurePosixPath(*parts))


def extra_video(video: str | Path, extra: str) -> Path:
    """The file of a video's alpha or depth, beside the colours."""
    path = Path(video)
    return path.with_name(f"{path.stem}_{extra}{path.suffix}")


def image_file(folder: Path, stem: str, ending: str, form: str) -> Path:
    """The file of a view's colour (ending "") or of one of its extras (ending "_alpha", ...)."""
    return folder / f"{stem}{ending}.{form}"


class ImageWriter:
    """Writes each view's colour, and its alpha and depth if they are among the extras.

    Parameters
    ----------
    folder : of the images.
    format : one of FORMATS.
    extras : any of EXTRAS.
    near_far : depths at the two ends of the colour map; None writes depth as 16 bits of grey.
    background : colour behind coloured depth.

    Attributes
    ----------
    depth_scales : by the path of a grey depth PNG within the folder, its full scale [world units].
    """

    def __init__(
        self,
        folder: Path,
        format: str = "png",
        extras: Sequence[str] = (),
        near_far: tuple[float, float] | None = None,
        background: Color = BLACK,
    ) -> None:
        self.folder, self.format, self.extras = folder, format, extras
        self.near_far, self.background = near_far, background
        self.depth_scales: dict[str, float] = {}

    def write(self, stem: str, image: Rendered) -> None:
        """Write the files of one view.

        Raises
        ------
        OutputError : a file cannot be written.
        """
        planes = {"": image.color} | {f"_{name}": getattr(image, name) for name in self.extras}
        for ending, plane in planes.items():
            path = image_file(self.folder, stem, ending, self.format)
            if self.format == "npy":
                content = io.BytesIO()
                np.save(content, np.ascontiguousarray(plane, np.float32))
                with atomic_writer(path) as stream:  # np.save would hide why a disk takes no more
                    stream.write(content.getbuffer())
            elif ending != "_depth":
                write_png(path, plane, render=True)
            elif self.near_far is not None:
                write_png(path, depth_picture(image, self.near_far, self.background), render=True)
            else:
                plane = np.maximum(plane, 0.0)  # opacities below zero may lead to depths below zero
                farthest = float(plane.max()) or 1.0
                write_grey16(path, np.rint(plane * (_FULL_SCALE / farthest)).astype(np.uint16))
                self.depth_scales[path.relative_to(self.folder).as_posix()] = farthest


class VideoFiles:
    """A video of the colours, and beside it `NAME_alpha` and `NAME_depth`; a context manager.

    Parameters
    ----------
    path : file of the colours' video.
    fps : frames a second.
    extras, near_far, background : as for `ImageWriter`; depth needs a range.

    Raises
    ------
    InputError : the ending is not known, or the encoder is not installed.
    """

    def __init__(
        self,
        path: Path,
        fps: float,
        extras: Sequence[str] = (),
        near_far: tuple[float, float] | None = None,
        background: Color = BLACK,
    ) -> None:
        self.near_far, self.background = near_far, background
        paths = {"colour": path} | {extra: extra_video(path, extra) for extra in extras}
        self.writers = {mode: VideoWriter(file, fps) for mode, file in paths.items()}
        self._open = ExitStack()

    def __enter__(self) -> VideoFiles:
        with ExitStack() as opening:
            for writer in self.writers.values():
                opening.enter_context(writer)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._open.__exit__(kind, error, trace)
            return
        with self._open:  # no file appears before all of them are complete
            for writer in self.writers.values():
                writer.finish()

    def write(self, stem: str, image: Rendered) -> None:
        """Add the view to every video."""
        for mode, writer in self.writers.items():
            writer.write(picture_of(image, mode, self.background, self.near_far))
