"""Views: images with their cameras, in memory or decoded from their files when they are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..cameras.camera import Camera
from ..files.images import ImageU8, resize_area
from ..files.masks import Mask, resize_mask


@dataclass(frozen=True, eq=False)
class View:
    """An image with its camera.

    Parameters
    ----------
    name : name of the image file in the scene's model.
    camera : pinhole camera with the image's size.
    image : (H, W, 3) uint8; photos with transparency are composited over the scene's background.
    mask : (H, W) bool, True for pixels that count; None if all pixels count.
    alpha : (H, W) uint8, opacity of a photo with transparency; None for other photos.
    """

    name: str
    camera: Camera
    image: ImageU8
    mask: Mask | None = None
    alpha: ImageU8 | None = None

    @property
    def may_hide_pixels(self) -> bool:
        """Whether a mask may hide some of the pixels."""
        return self.mask is not None

    def loaded(self) -> View:
        """Return the view with its pixels in memory."""
        return self

    def release(self) -> None:
        """Give up the pixels in memory if they can be decoded again: no effect on a view without a file."""

    def resized(self, width: int, height: int) -> View:
        """Return the view at another size [px]."""
        view = self.loaded()
        if (width, height) == (view.camera.width, view.camera.height):
            return view
        return View(
            view.name,
            view.camera.resized(width, height),
            resize_area(view.image, width, height),
            None if view.mask is None else resize_mask(view.mask, width, height),
            None if view.alpha is None else resize_area(view.alpha, width, height),
        )


class StoredView(View):
    """A view of a photo that can be decoded again, so that its pixels need not stay in memory.

    While the pixels are not kept, each use of `image`, `mask` or `alpha` decodes the photo. Whoever needs two of them,
    or one of them twice, takes `loaded()`.

    Parameters
    ----------
    name, camera : as for `View`.
    read : decodes the photo. It raises InputError if the photo cannot be used.
    decoding_bytes : memory that this needs beside the result.
    kept : the view with its pixels in memory; None if they are not kept.
    may_hide_pixels : whether a mask may hide some of the pixels.
    """

    decoding_bytes: int
    _read: Callable[[], View]
    _kept: View | None
    _may_hide_pixels: bool

    def __new__(cls, *_: Any, **fields: Any) -> Any:
        """Return a `View` for the fields of one, because `dataclasses.replace` calls the class with them."""
        return View(**fields) if "image" in fields else super().__new__(cls)

    def __init__(
        self,
        name: str,
        camera: Camera,
        read: Callable[[], View],
        decoding_bytes: int = 0,
        kept: View | None = None,
        may_hide_pixels: bool = True,
    ) -> None:
        values = {"name": name, "camera": camera, "decoding_bytes": decoding_bytes, "_read": read, "_kept": kept}
        values["_may_hide_pixels"] = may_hide_pixels
        for key, value in values.items():
            object.__setattr__(self, key, value)  # the base class is frozen

    def __repr__(self) -> str:
        return f"StoredView({self.name!r}, {self.camera!r})"

    @property
    def image(self) -> ImageU8:
        """Pixels of the photo, (H, W, 3) uint8."""
        return self.loaded().image

    @property
    def mask(self) -> Mask | None:
        """Pixels that count, as for `View`."""
        return self.loaded().mask

    @property
    def alpha(self) -> ImageU8 | None:
        """Opacity of the photo, as for `View`."""
        return self.loaded().alpha

    @property
    def may_hide_pixels(self) -> bool:
        """Whether a mask may hide some of the pixels. This does not decode the photo."""
        return self._may_hide_pixels

    @property
    def is_kept(self) -> bool:
        """Whether the pixels are in memory."""
        return self._kept is not None

    def loaded(self) -> View:
        """Return the view with its pixels in memory. Raise InputError if the photo cannot be used."""
        return self._kept or self._read()

    def changed(self, change: Callable[[View], View], working_bytes: int = 0) -> StoredView:
        """Return a view that applies `change` to the pixels whenever they are decoded.

        Parameters
        ----------
        change : returns another view of the same size. A mask that it adds needs `may_hide_pixels`.
        working_bytes : memory that it needs beside its result.
        """
        return StoredView(
            self.name,
            self.camera,
            lambda: change(self._read()),
            max(self.decoding_bytes, working_bytes),
            None if self._kept is None else change(self._kept),
            self.may_hide_pixels,
        )

    def keep(self) -> None:
        """Decode the photo, and keep the pixels until `release`. Raise InputError if the photo cannot be used."""
        object.__setattr__(self, "_kept", self.loaded())

    def release(self) -> None:
        """Give up the pixels in memory. The next use decodes the photo again."""
        object.__setattr__(self, "_kept", None)
