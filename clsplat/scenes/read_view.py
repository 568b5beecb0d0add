"""Decoding of photos to views: composited, undistorted, masked and reduced, several photos at a time."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .. import activity
from ..cameras.camera import Camera
from ..errors import InputError
from ..files.host_memory import give_back_free_memory
from ..files.images import ImageU8, has_alpha, is_whole, read_image, resize_area
from ..files.masks import Mask, read_mask, resize_mask
from ..splats.color import Color
from .bars import NO_BARS, Bars
from .options import ALPHA_USES
from .photo_size import target_size
from .posed_images import PosedImages
from .undistort import RegisteredImage, is_pinhole
from .view import StoredView, View

_SOFT_ROWS = 1  # beside a bar, which may have a part of both
_OPAQUE = 128  # smallest alpha of a pixel that counts, if transparency is a mask
_ROWS = 64  # rows that are composited at a time, which keeps the real numbers small
# Bytes of a pixel at its stored size while a photo is decoded: Pillow's image and an array of it. Undistortion holds
# the photo and its result, each as an array and as a bitmap of pycolmap.
_DECODED_BYTES, _UNDISTORTED_BYTES = 8, 16
_ALL_DECODED_BYTES = 512 << 20  # of all photos that are decoded at the same time


@dataclass(frozen=True)
class PhotoReader:
    """Reads the view of one photo; parameters as those of `load_scene`.

    Parameters
    ----------
    photo : the photo's name, pose and lens.
    file : its file. size : its (width, height) as read, before `resolution` [px].
    mask_file : file of its mask, if it has one.
    alpha : use of its transparency, one of ALPHA_USES.
    bars : bars of the photo, which are masked out.
    upright : whether the photo is turned by its EXIF orientation.
    rim : pixels of a rim around the photo, (H, W), which are masked out; None without a rim.
    """

    photo: RegisteredImage
    file: Path
    size: tuple[int, int]
    resolution: int
    background: Color
    mask_file: Path | None
    alpha: str = ALPHA_USES[0]
    bars: Bars = NO_BARS
    upright: bool = False
    rim: Mask | None = field(default=None, compare=False)

    @classmethod
    def of(
        cls,
        posed: PosedImages,
        photo: RegisteredImage,
        resolution: int,
        background: Color,
        mask_file: Path | None = None,
        alpha: str = ALPHA_USES[0],
        bars: Bars = NO_BARS,
        rim: Mask | None = None,
    ) -> PhotoReader:
        """Return the reader of one of the photos of a scene."""
        name = photo.name
        file, size, upright = posed.files[name], posed.sizes[name], name in posed.upright
        return cls(photo, file, size, resolution, background, mask_file, alpha, bars, upright, rim)

    @property
    def alpha_hides(self) -> bool:
        """Whether transparency is a mask."""
        return self.alpha == "mask"

    @property
    def decoding_bytes(self) -> int:
        """Bytes of memory that decoding needs at most, beside the result."""
        width, height = self.size
        return width * height * (_DECODED_BYTES if is_pinhole(self.photo.lens) else _UNDISTORTED_BYTES)

    @property
    def may_hide_pixels(self) -> bool:
        """Whether a mask may hide some of the pixels, or all."""
        return self.mask_file is not None or self.alpha_hides or any(self.bars) or self.rim is not None

    def camera(self) -> Camera:
        """Return the camera of the view without decoding the photo; raises as `RegisteredImage.fit`."""
        camera = self.photo.fitted_camera(*self.size)
        return camera.resized(*target_size(camera.width, camera.height, self.resolution))

    def read(self, look: Callable[[ImageU8], None] | None = None) -> View | str:
        """Return the view, or the reason why the photo cannot be used.

        Parameters
        ----------
        look : called with the pixels as they are stored (`read_image`), for whoever needs both and decodes once.

        Raises
        ------
        InputError : a mask is damaged, or sizes do not fit.
        """
        camera = self.camera()
        size = camera.width, camera.height
        try:
            stored = read_image(
                self.file, upright=self.upright, opaque_size=size if is_pinhole(self.photo.lens) else None
            )
        except InputError as error:
            return str(error)
        if look is not None:
            look(stored)
        masks = self._stored_masks()
        alpha = None
        if self.alpha == "ignore":
            stored = stored[:, :, :3]
        if stored.shape[2] == 4:
            alpha = stored[:, :, 3].copy()  # a slice would keep the whole photo in memory
            if self.alpha_hides:
                masks.append(alpha >= _OPAQUE)
                alpha, stored = None, stored[:, :, :3]
            else:
                stored = _composited(stored, self.background)
        image = self._fitted(np.ascontiguousarray(stored), size)
        del stored
        mask = self._fitted_mask(masks, size) if masks else None
        view = View(
            self.photo.name,
            camera,
            image,
            mask,
            None if alpha is None else resize_area(self.photo.fit_alpha(alpha), *size),
        )
        if mask is None:
            return view
        if not mask.any():
            return self._all_hidden
        return replace(view, mask=None) if mask.all() else view

    def unusable(self) -> str | None:
        """Return the reason why the photo cannot be used, as far as a check shows it; None without one.

        The photo is decoded only if its transparency is a mask, or if its file does not end as it should.

        Raises
        ------
        InputError : as `read`.
        """
        if not is_whole(self.file) or (self.alpha_hides and has_alpha(self.file)):
            found = self.read()
            return found if isinstance(found, str) else None
        masks, camera = self._stored_masks(), self.camera()
        shown = not masks or self._fitted_mask(masks, (camera.width, camera.height)).any()
        return None if shown else self._all_hidden

    @property
    def _all_hidden(self) -> str:
        return f"{self.file}: its mask hides every pixel"

    def _stored_masks(self) -> list[Mask]:
        """Return the masks that do not need the photo: of a file, of bars, and of a rim."""
        masks = [] if self.mask_file is None else [read_mask(self.mask_file)]
        if any(self.bars):
            masks.append(self.bars.uncovered(*self.size, _SOFT_ROWS))
        if self.rim is not None:
            masks.append(~self.rim)
        return masks

    def opaque_part(self, stored: ImageU8) -> Mask:
        """Return which pixels of the view are at least half opaque. stored : (H, W, 4), as of `read`."""
        camera = self.camera()
        return self._fitted_mask([stored[:, :, 3] >= _OPAQUE], (camera.width, camera.height))

    def _fitted_mask(self, masks: Sequence[Mask], size: tuple[int, int]) -> Mask:
        """Return which pixels of the view all masks of the photo keep."""
        fitted = [self.photo.fit_mask(each, *self.size) for each in masks]
        return resize_mask(np.logical_and.reduce(fitted), *size)

    def _fitted(self, stored: ImageU8, size: tuple[int, int]) -> ImageU8:
        """Return opaque pixels, as stored or reduced already, at the size of the view and without distortion."""
        if is_pinhole(self.photo.lens):
            return stored if stored.shape[1::-1] == size else resize_area(stored, *size)
        image, camera = self.photo.fit(stored)
        return image if (camera.width, camera.height) == size else resize_area(image, *size)

    def view(self, look: Callable[[ImageU8], None] | None = None) -> View:
        """Return the view; raise InputError if the photo cannot be used. look : as of `read`."""
        found = self.read(look)
        if isinstance(found, str):
            raise InputError(found)
        return found


def read_views(
    readers: Sequence[PhotoReader], now: Sequence[bool], decoded: Mapping[str, View] | None = None
) -> list[View | str]:
    """Return the view of each photo, or the reason why it cannot be used.

    Parameters
    ----------
    now : whether to decode each photo now and keep it. Other photos become a `StoredView` and are checked
        (`PhotoReader.unusable`).
    decoded : views by name that were read before, of photos without masks.
    """
    numbers, n, known = itertools.count(1), sum(now), decoded or {}

    def one(reader: PhotoReader, keep: bool) -> View | str:
        if keep:
            activity.report(f"reading photo {next(numbers)} of {n}")
        view = known.get(reader.photo.name) if keep and not reader.may_hide_pixels else None
        if view is None:
            found = reader.read() if keep else reader.unusable()
            if isinstance(found, str):
                return found
            view = found
        return StoredView(
            reader.photo.name, reader.camera(), reader.view, reader.decoding_bytes, view, reader.may_hide_pixels
        )

    workers = decoding_threads([reader.decoding_bytes for reader in readers])
    with ThreadPoolExecutor(workers) as pool:  # decoding and resizing release the interpreter lock
        views = list(pool.map(one, readers, now))
    give_back_free_memory()
    return views


def keep_photos(views: Iterable[View]) -> None:
    """Decode the photos of views that are not in memory, and keep them.

    Raises
    ------
    InputError : a photo cannot be used.
    """
    stored = [view for view in views if isinstance(view, StoredView) and not view.is_kept]
    if not stored:
        return
    numbers = itertools.count(1)

    def one(view: StoredView) -> None:
        activity.report(f"reading photo {next(numbers)} of {len(stored)}")
        view.keep()

    with ThreadPoolExecutor(decoding_threads([view.decoding_bytes for view in stored])) as pool:
        list(pool.map(one, stored))
    give_back_free_memory()


def decoding_threads(decoding_bytes: Sequence[int]) -> int:
    """Return the number of photos to decode at the same time: one a processor, as far as memory allows.

    Parameters
    ----------
    decoding_bytes : memory that each of the photos needs while it is decoded.
    """
    return max(1, min(os.cpu_count() or 1, _ALL_DECODED_BYTES // max(max(decoding_bytes, default=1), 1)))


def _composited(image: ImageU8, background: Color) -> ImageU8:
    """Return an image (H, W, 4) with straight alpha over the background, (H, W, 3)."""
    composited = np.empty((*image.shape[:2], 3), np.uint8)
    under = 255.0 * np.clip(np.asarray(background, np.float32), 0.0, 1.0)
    for start in range(0, len(image), _ROWS):
        rows = image[start : start + _ROWS]
        alpha = rows[:, :, 3:].astype(np.float32) / 255.0
        blended = alpha * rows[:, :, :3].astype(np.float32) + (1.0 - alpha) * under
        composited[start : start + _ROWS] = np.rint(blended)
    return composited
