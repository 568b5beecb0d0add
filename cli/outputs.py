"""Files of rendered views: their names, which come from foreign files, and their formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from clsplat.atomic import atomic_writer
from clsplat.cameras_json import bare_name
from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.render import Rendered

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
                raise InputError(f"views {taken[file]!r} and {name!r} would both be written to {file}: "
                                 "rename one of them")
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


class ImageWriter:
    """Writes one view's colour, and alpha and depth if wanted.

    Parameters
    ----------
    format : "png" or "npy". extras : any of "alpha", "depth".
    """

    def __init__(self, folder: Path, format: str, extras: Sequence[str] = ()) -> None:
        self.folder, self.format, self.extras = folder, format, extras

    def write(self, stem: str, image: Rendered) -> str | None:
        """Write the files; the scale of a depth PNG to tell the user, else None."""
        from clsplat.images import write_grey16, write_png

        planes = {"": image.color} | {f"_{name}": getattr(image, name) for name in self.extras}
        note = None
        for ending, plane in planes.items():
            path = self.folder / f"{stem}{ending}.{self.format}"
            if self.format == "npy":
                with atomic_writer(path) as stream:
                    np.save(stream, np.ascontiguousarray(plane, np.float32))
            elif ending == "_depth":
                farthest = float(plane.max()) or 1.0
                write_grey16(path, np.rint(plane * (_FULL_SCALE / farthest)).astype(np.uint16))
                note = f"{path.name}: {_FULL_SCALE} = {farthest:.6g} world units"
            else:
                write_png(path, plane)
        return note
