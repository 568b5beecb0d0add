"""Render passes for Blender: splats of several objects in one image, in the colours of Blender, without `bpy`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.rendering.renderer import Rendered, Renderer
from clsplat.splats.similarity import similarity
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined, transformed

from .lens import moved

Pixels = NDArray[np.float32]

NOTHING = 1e10  # the depth of empty pixels in Blender
_VISIBLE = 1 / 255  # the least alpha of a pixel with a depth


@dataclass(frozen=True, eq=False)
class Placed:
    """An object of splats: its name, its PLY file, and its matrix to the world (4, 4)."""

    name: str
    ply: Path
    matrix: NDArray[np.float64]

    @property
    def key(self) -> tuple[object, ...]:
        """Key that is equal for an unchanged file at the same place."""
        status = self.ply.stat()
        return (str(self.ply), status.st_mtime_ns, status.st_size, self.matrix.tobytes())


class Studio:
    """Renderer of objects of splats; it keeps models until their files or places change.

    Parameters
    ----------
    device : device name for `clsplat.Renderer`.
    """

    def __init__(self, device: str | None = None) -> None:
        self.renderer = Renderer(device)
        self._lock = Lock()  # Blender renders in another thread while the viewport draws
        self._files: dict[tuple[object, ...], Splats] = {}
        self._joined: tuple[tuple[object, ...], Splats] | None = None
        self._clipped: tuple[Splats, bytes, Splats] | None = None

    def render(self, objects: Sequence[Placed], camera: Camera, clip: tuple[float, float] = (0.0, np.inf)) -> Rendered:
        """Render the splats of all objects before black; depths are in world units.

        For a single object the camera is moved instead of the splats. The image then has the bits of `clsplat render`.

        Parameters
        ----------
        clip : nearest and farthest depth of the centres of visible splats [world units].

        Raises
        ------
        InputError : a PLY file cannot be read, a transform is not a similarity, or shapes cannot be joined. The message
            names the object.
        """
        with self._lock:
            return self._render(objects, camera, clip)

    def _render(self, objects: Sequence[Placed], camera: Camera, clip: tuple[float, float]) -> Rendered:
        objects = [item for item in objects if len(self._read(item))]
        if not objects:
            nothing = np.zeros((camera.height, camera.width), np.float32)
            return Rendered(np.zeros((camera.height, camera.width, 3), np.float32), nothing, nothing)
        if len(objects) > 1:
            return self.renderer.render(self._between(self._together(objects), camera, clip), camera)
        scale, rotation, translation = placement(objects[0])
        camera = moved(camera, scale, rotation, translation)
        near, far = clip[0] / scale, clip[1] / scale
        image = self.renderer.render(self._between(self._read(objects[0]), camera, (near, far)), camera)
        return Rendered(image.color, image.alpha, image.depth * np.float32(scale))

    def _read(self, item: Placed) -> Splats:
        try:
            key = item.key[:3]
        except OSError as error:
            raise InputError(f"{item.name}: {item.ply}: {error.strerror}; choose its PLY again") from None
        if key not in self._files:
            self._files = {other: splats for other, splats in self._files.items() if other[0] != key[0]}
            try:
                self._files[key] = Splats.load(item.ply)
            except InputError as error:
                raise InputError(f"{item.name}: {error}") from None
        return self._files[key]

    def _together(self, objects: Sequence[Placed]) -> Splats:
        key = tuple(item.key for item in objects)
        if self._joined is None or self._joined[0] != key:
            for item in objects:
                placement(item)
            self._joined = (key, joined([transformed(self._read(item), item.matrix) for item in objects]))
        return self._joined[1]

    def _between(self, splats: Splats, camera: Camera, clip: tuple[float, float]) -> Splats:
        """Return the splats with centres between the clip distances; the same object as long as they do not change."""
        depth = splats.mean @ camera.rotation[2].astype(np.float32) + np.float32(camera.translation[2])
        inside = (depth >= clip[0]) & (depth <= clip[1])
        if inside.all():
            return splats
        mask = inside.tobytes()
        if self._clipped is None or self._clipped[0] is not splats or self._clipped[1] != mask:
            self._clipped = (splats, mask, splats.select(inside))
        return self._clipped[2]


def placement(item: Placed) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return scale, rotation and translation of an object; raise InputError with its name if it is not a similarity."""
    try:
        return similarity(item.matrix)
    except InputError as error:
        raise InputError(f"{item.name}: {error}") from None


def to_linear(encoded: Pixels) -> Pixels:
    """Convert display values to light: the inverse of the sRGB curve (IEC 61966-2-1)."""
    low, high = encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def combined(image: Rendered, background: Sequence[float] | None, linear: bool = True) -> Pixels:
    """Return the Combined pass of Blender (H, W, 4): premultiplied, from the bottom row up.

    Splats are trained on photographs, so their colours and blending are those of display values. Blender expects light;
    its Standard view transform converts it back to the same bytes.

    Parameters
    ----------
    image : render before black. background : display values behind the splats, or None for a transparent image.
    linear : convert display values to light. Leave it out for the view transform Raw, which shows values unchanged.
    """
    cover = np.clip(image.alpha, 0.0, 1.0)[..., None].astype(np.float32)
    colour = image.color.astype(np.float32)
    curve = to_linear if linear else np.asarray
    if background is not None:
        behind = (1 - image.alpha[..., None]) * np.asarray(background, np.float32)
        pixels = [curve(colour + behind.astype(np.float32)), np.ones_like(cover)]
    else:
        straight = np.divide(colour, cover, out=np.zeros_like(colour), where=cover > 0)
        pixels = [curve(straight) * cover, cover]
    return np.ascontiguousarray(np.concatenate(pixels, axis=2)[::-1], np.float32)


def depths(image: Rendered) -> Pixels:
    """Return the Depth pass of Blender (H, W): mean depth along the view axis, from the bottom row up.

    Empty pixels have the depth `NOTHING`.
    """
    solid = image.alpha >= _VISIBLE
    mean = np.divide(image.depth, image.alpha, out=np.full(image.depth.shape, NOTHING, image.depth.dtype), where=solid)
    return np.ascontiguousarray(mean[::-1], np.float32)
