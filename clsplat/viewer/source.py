"""Sources of frames: a model on the device, and a watcher that reads its file again when it changes."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..errors import ClsplatError, InputError
from ..models.detail import DetailLevels
from ..rendering.colormaps import MODES, Picture, depth_picture, depth_range, model_for, picture
from ..rendering.renderer import Rendered, Renderer
from ..splats.fields import DoubleArray
from ..splats.shapes import shape_named
from ..splats.splats import Splats
from .crop import CropBox
from .settings import Settings

_PROBE, _PROBE_FOCAL = 5, 1000.0  # size and focal length of the image that finds a surface [px]
KEPT = 4  # models on the device at once: parts for clients with another cap or mode


@dataclass(frozen=True)
class ViewPicture:
    """A picture and the depths at the two ends of its colours, None if it does not show depth."""

    picture: Picture
    near_far: tuple[float, float] | None = None


class Source(Protocol):
    """A source of frames.

    Attributes
    ----------
    modes : modes from `colormaps.MODES`. partial : whether a part of the splats can be shown.
    """

    @property
    def splats(self) -> Splats | None:
        """The model on the host; None during a run."""
        ...

    @property
    def n_splats(self) -> int: ...

    @property
    def sh_degree(self) -> int: ...

    @property
    def modes(self) -> tuple[str, ...]: ...

    @property
    def partial(self) -> bool: ...

    @property
    def sides(self) -> tuple[str, str] | None:
        """Names of two models that share the picture; None for one model."""
        ...

    def view(self, camera: Camera, settings: Settings) -> ViewPicture:
        """Return the view of a camera, in the size of its image."""

    def surface(
        self, origin: DoubleArray, direction: DoubleArray, settings: Settings, across: float = 0.0
    ) -> DoubleArray | None:
        """Return the point (3,) where a ray meets what is shown; None if it meets nothing, or during a run.

        across : where the ray crosses the picture, as a share of its width.
        """


class ModelSource:
    """A model on the device.

    Parameters
    ----------
    splats : the first model. keep : number of models that stay on the device.
    detail : levels of detail, as `pixels` of `DetailLevels.choose`; 0 draws all splats.
    """

    modes = MODES
    partial = True
    sides = None

    def __init__(self, splats: Splats, device: str | None = None, keep: int = KEPT, detail: float = 0.0) -> None:
        self.renderer = Renderer(device, keep=keep)
        self._detail = detail
        self._rendering = threading.Lock()  # only one thread at a time may use a renderer
        self._keep = keep
        self.show(splats)

    def show(self, splats: Splats) -> None:
        """Show another model from the next frame on; any thread may call this."""
        # One assignment: a frame in progress sees either the old model or the new one.
        self._shown = _Shown(splats, self._keep, DetailLevels(splats) if self._detail else None, self._detail)

    @property
    def splats(self) -> Splats:
        return self._shown.splats

    @property
    def n_splats(self) -> int:
        return len(self.splats)

    @property
    def sh_degree(self) -> int:
        return self.splats.sh_degree

    def picture(self, camera: Camera, settings: Settings) -> Picture:
        """Return the picture of a camera; with full settings it has the bytes of `clsplat render`."""
        return self.view(camera, settings).picture

    def view(self, camera: Camera, settings: Settings) -> ViewPicture:
        """Return the view of a camera."""
        mode, background, degree = settings.mode, settings.background, settings.sh_degree
        if mode == "depth":
            return depth_view(self.rendered(camera, settings), settings)
        with self._rendering:
            splats = self._shown.seen(camera, settings)
            return ViewPicture(picture(self.renderer, splats, camera, mode, background, sh_degree=degree))

    def rendered(self, camera: Camera, settings: Settings) -> Rendered:
        """Return the image of a camera with its depths."""
        with self._rendering:
            splats = self._shown.seen(camera, settings)
            return self.renderer.render(splats, camera, settings.background, settings.sh_degree)

    def surface(
        self, origin: DoubleArray, direction: DoubleArray, settings: Settings, across: float = 0.0
    ) -> DoubleArray | None:
        """Return the point (3,) where a ray meets what is shown, by the mean depth of a tiny image; None beside it."""
        camera = _camera_along(origin, direction)
        if camera is None:
            return None
        image = self.rendered(camera, settings)
        depth = image.median_depth
        return None if depth is None else camera.position + depth * camera.rotation[2]


def depth_view(image: Rendered, settings: Settings) -> ViewPicture:
    """Return the depth of a rendered image in colours, with the range of its depths."""
    near_far = depth_range(image)
    return ViewPicture(depth_picture(image, near_far, settings.background), near_far)


def _camera_along(origin: DoubleArray, direction: DoubleArray) -> Camera | None:
    """Return a camera that looks along a ray, with a very small angle of view; None for an unusable ray."""
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(origin).all() and 0.0 < length < math.inf):
        return None
    ahead = direction / length
    aside = np.cross(np.eye(3)[np.abs(ahead).argmin()], ahead)
    aside /= np.linalg.norm(aside)
    rotation = np.stack([aside, np.cross(ahead, aside), ahead])
    pose = np.concatenate([rotation, -rotation @ origin[:, None]], axis=1)
    return Camera(_PROBE, _PROBE, _PROBE_FOCAL, _PROBE_FOCAL, 0.5 * _PROBE, 0.5 * _PROBE, pose)


class _Shown:
    """A model and its most recently requested parts. With `levels`, the whole model is drawn in levels of detail."""

    def __init__(self, splats: Splats, keep: int, levels: DetailLevels | None = None, pixels: float = 0.0) -> None:
        self.splats, self._keep, self._levels, self._pixels = splats, keep, levels, pixels
        self._order: NDArray[np.intp] | None = None
        self._parts: dict[tuple[int, bool, CropBox | None], Splats] = {}

    def seen(self, camera: Camera, settings: Settings) -> Splats:
        """Return the splats to draw for a camera."""
        splats = self.part(settings.cap, settings.mode, settings.crop)
        if self._levels is None or splats is not self.splats:
            return splats
        return self._levels.seen(camera, self._pixels)

    def part(self, cap: int | None, mode: str, crop: CropBox | None = None) -> Splats:
        """Return the `cap` splats of the box that cover most, in the order of the file, coloured for the mode."""
        n = len(self.splats) if cap is None else min(cap, len(self.splats))
        skew = mode == "skew"
        if n == len(self.splats) and not skew and crop is None:
            return self.splats
        part = self._parts.pop((n, skew, crop), None)
        if part is None:
            part = model_for(self._chosen(n, crop), mode)
            while len(self._parts) >= self._keep - 1:
                del self._parts[next(iter(self._parts))]
        self._parts[n, skew, crop] = part
        return part

    def _chosen(self, n: int, crop: CropBox | None) -> Splats:
        if n == len(self.splats):
            return self.splats if crop is None else self.splats.select(crop.contains(self.splats.mean))
        if self._order is None:
            self._order = np.argsort(-coverage(self.splats), kind="stable")
        order = self._order if crop is None else self._order[crop.contains(self.splats.mean)[self._order]]
        return self.splats.select(np.sort(order[:n]))


def coverage(splats: Splats) -> NDArray[np.float64]:
    """Return (N,) opacity times the area of the two longest axes, an estimate of how much a splat covers."""
    strength = shape_named(splats.shape).strength(splats.arrays)
    longest = np.sort(splats.log_scale.astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    return np.asarray(strength * np.exp(np.clip(longest, -200.0, 200.0)), np.float64)


class ModelWatcher:
    """A model file that is polled and read again after a change, once it is complete.

    Parameters
    ----------
    find : returns the file to show now, such as the last iteration of a model folder. It raises InputError if there is
        no such file.
    """

    def __init__(self, find: Callable[[], Path]) -> None:
        self._find = find
        self.path = find()
        self._read = self._seen = _stamp(self.path)

    def poll(self) -> Splats | None:
        """Return the new model, or None if the file has not changed or is still being written.

        Raises
        ------
        InputError : the new file is unusable; raised once for each state of the file.
        """
        try:
            path = self._find()
        except InputError:
            self._read = self._seen = ()  # if it comes back as it was, it is read again, and the error is over
            raise
        stamp = _stamp(path)
        # A file is read once it has stayed the same between two polls.
        settled, self._seen = stamp == self._seen, stamp
        if not settled or stamp == self._read:
            return None
        return self._load(path, stamp)

    def reload(self) -> Splats:
        """Return the model in the file now. Raises InputError."""
        path = self._find()
        return self._load(path, _stamp(path))

    def _load(self, path: Path, stamp: tuple[object, ...]) -> Splats:
        self._read = self._seen = stamp
        if len(stamp) == 1:
            raise InputError(f"{path}: does not exist any more")
        try:
            splats = Splats.load(path)
        except ClsplatError:
            raise
        except (OSError, MemoryError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None
        self.path = path
        return splats


def _stamp(path: Path) -> tuple[object, ...]:
    """Return values that change with the file; (path,) if it does not exist."""
    try:
        status = os.stat(path)
    except OSError:
        return (path,)
    return path, status.st_mtime_ns, status.st_size, status.st_ino
