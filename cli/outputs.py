"""What rendered views are written to: images, whose names come from foreign files, and videos."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from clsplat.errors import InputError
from clsplat.files.atomic import atomic_writer
from clsplat.files.image_names import bare_name
from clsplat.splats.color import BLACK, Color

if TYPE_CHECKING:
    from clsplat.rendering.renderer import Rendered


_FULL_SCALE = 65535


def output_stems(names: Sequence[str], extras: Sequence[str] = (), keep_suffix: bool = False) -> list[str]:
    """File names without suffix, one for each view: its name less an image's extension, folders kept.

    Parameters
    ----------
    keep_suffix : keep the extension: an array's file is called exactly `<img_name>.npy`.
    extras : "alpha" and "depth" where those are written beside.

    Raises
    ------
    InputError : a name that would leave the output folder, or two views with the same file.
    """
    stems: list[str] = []
    taken: dict[str, str] = {}
    for name in names:
        stem = _safe(name) if keep_suffix else bare_name(_safe(name))
        for file in (stem, *(f"{stem}_{extra}" for extra in extras)):
            if file in taken:
                raise InputError(
                    f"views {taken[file]!r} and {name!r} would both be written to {file}: rename one of them"
                )
            taken[file] = name
        stems.append(stem)
    return stems


def _safe(name: str) -> str:
    """The name as a relative path with forward slashes."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
    absolute = name.startswith(("/", "\\")) or (bool(parts) and ":" in parts[0])
    if not parts or absolute or ".." in parts or "\0" in name:
        raise InputError(f"view {name!r}: its image would lie outside the output folder: rename it")
    return str(PurePosixPath(*parts))


def beside(video: Path, extra: str) -> Path:
    """The file of a video's alpha or depth."""
    return video.with_name(f"{video.stem}_{extra}{video.suffix}")


class ImageWriter:
    """Writes one view's colour, and alpha and depth if wanted.

    Parameters
    ----------
    format : "png" or "npy". extras : any of "alpha", "depth".
    near_far : depths at the ends of the colour map, for coloured depth PNGs; None: 16 bits of grey.
    background : behind coloured depth.
    """

    def __init__(
        self,
        folder: Path,
        format: str,
        extras: Sequence[str] = (),
        near_far: tuple[float, float] | None = None,
        background: Color = BLACK,
    ) -> None:
        self.folder, self.format, self.extras = folder, format, extras
        self.near_far, self.background = near_far, background

    def write(self, stem: str, image: Rendered) -> str | None:
        """Write the files; the scale of a grey depth PNG to tell the user, else None."""
        from clsplat.files.images import write_grey16, write_png

        planes = {"": image.color} | {f"_{name}": getattr(image, name) for name in self.extras}
        note = None
        for ending, plane in planes.items():
            path = self.folder / f"{stem}{ending}.{self.format}"
            if self.format == "npy":
                with atomic_writer(path) as stream:
                    np.save(stream, np.ascontiguousarray(plane, np.float32))
            elif ending != "_depth":
                write_png(path, plane)
            elif self.near_far is not None:
                from clsplat.rendering.colormaps import depth_picture

                write_png(path, depth_picture(image, self.near_far, self.background))
            else:
                farthest = float(plane.max()) or 1.0
                write_grey16(path, np.rint(plane * (_FULL_SCALE / farthest)).astype(np.uint16))
                note = f"{path.name}: {_FULL_SCALE} = {farthest:.6g} world units"
        return note


class VideoFiles:
    """A video of the colours, and beside it `NAME_alpha` and `NAME_depth` if wanted; use as a context manager.

    Parameters
    ----------
    path : of the colours' video. fps : frames a second.
    extras, near_far, background : as in ImageWriter; the depths need a range.

    Raises
    ------
    InputError : no known kind of video, or the encoder is not installed.
    """

    def __init__(
        self,
        path: Path,
        fps: float,
        extras: Sequence[str] = (),
        near_far: tuple[float, float] | None = None,
        background: Color = BLACK,
    ) -> None:
        from clsplat.files.video import VideoWriter

        self.near_far, self.background = near_far, background
        paths = {"colour": path} | {extra: beside(path, extra) for extra in extras}
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
        self._open.__exit__(kind, error, trace)

    def write(self, stem: str, image: Rendered) -> None:
        """Add the view to every video."""
        from clsplat.rendering.colormaps import picture_of

        for mode, writer in self.writers.items():
            writer.write(picture_of(image, mode, self.background, self.near_far))
