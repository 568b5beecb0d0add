"""What stands between a render and its photo in training: exposure, masks, transparency over random backgrounds.

The exposure of a photo is an affine map from the render's colours to its own (as in 3DGS). Whenever a view is trained
on, its exposure goes a part of the way to the one of least squares for the present render; the mean of all exposures
stays the identity, which is what views without a photo are shown with. 3DGS learns exposures by Adam: as good at the
best of three rates, worse at its own (ARCHITECTURE.md). Without exposures, masks
and transparency none of them runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..device.memory import to_device, to_host
from ..device.program import lane_group
from ..errors import InputError
from ..rendering.pipeline import ImageLayout
from ..splats.color import Color
from .config import TrainConfig
from .loss import ImageLoss
from .programs import EXPOSURE_GROUP, EXPOSURE_VECS, exposure_program
from .targets import Truth, Truths

_KEY = "exposure"  # of the state
_SIZE = 12  # rows of three factors and an offset
_SUMS = 22  # of cl/train/exposure.cl
_IDENTITY = np.eye(3, 4)


class PhotoLoss:
    """The loss of renders against training photos, and the photos' exposures.

    Parameters
    ----------
    background : that transparent photos lie over.
    """

    def __init__(self, loss: ImageLoss, truths: Truths, config: TrainConfig, background: Color) -> None:
        self.loss, self.truths, self.config, self.background = loss, truths, config, background
        self.device, self.pipeline, self.kernels = loss.device, loss.pipeline, loss.kernels
        self.learns = config.exposure
        self.in_use = needs_photos(config, truths.channels)
        if not self.in_use:
            return
        self.program = exposure_program(self.device, self.kernels)
        self._rows = np.tile(_IDENTITY.ravel(), (len(truths.views), 1)).astype(self.kernels.dtype)
        self._exposures = self.device.alloc(self._rows.nbytes)
        to_device(self.device, self._exposures, self._rows)

    def gradient(self, truth: Truth, background: Color) -> Any:
        """Gradient with respect to the pipeline's "color", rendered over `background`; the exposure makes its step."""
        planes = self.truths.planes(truth)
        if not self.in_use:
            return self.loss.gradient(truth.layout, planes)
        layout, channels = truth.layout, self.truths.channels
        pool, image = self.pipeline.pool, self.pipeline.image
        photo, target = image("photo", layout, 3), planes
        if channels > 3:  # a buffer of bytes with a zero margin
            target = image("photo_target", layout, -(-3 // self.kernels.dtype.itemsize))
        items = -(-layout.width // (self.kernels.lanes * EXPOSURE_VECS))
        group = min(lane_group(self.device), items)
        size = -(-items // group) * group, layout.height
        shift = [255.0 * (new - old) for new, old in zip(background, self.background, strict=True)]
        common = {
            "color": image("color", layout, 3),
            "truth": planes,
            "exposures": self._exposures,
            "view": truth.index,
            "channels": channels,
            "width": layout.width,
            "height": layout.height,
            "stride": layout.stride,
            "plane": layout.plane,
        }
        self.program.photo_of_render(
            size, (group, 1), photo=photo, target=target, shift_r=shift[0], shift_g=shift[1], shift_b=shift[2], **common
        )
        v = self.loss.gradient(layout, target, photo, truth.counted)
        parts = items * layout.height
        partial = pool.get("exposure_partial", _SUMS * parts * self.kernels.dtype.itemsize)
        self.program.photo_of_render_vjp(size, (group, 1), v=v, target=target, partial=partial, **common)
        if self.learns:
            self.program.step_exposure(
                (EXPOSURE_GROUP,),
                (EXPOSURE_GROUP,),
                exposures=self._exposures,
                partial=partial,
                parts=parts,
                view=truth.index,
                views=len(self.truths.views),
                rate=self.config.exposure_rate,
                pull=self.config.exposure_pull,
            )
        return v

    def exposures(self) -> NDArray[np.floating]:
        """(views, 3, 4): photo = [:, :3] render + [:, 3]; the identity where none is learned."""
        if not self.in_use:
            return np.tile(_IDENTITY, (len(self.truths.views), 1, 1))
        return self._download().reshape(-1, 3, 4)

    def state(self) -> dict[str, NDArray[Any]]:
        """What a resumed run goes on from."""
        return {_KEY: self._download()} if self.learns else {}

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Take what `state` gave out of a larger one."""
        rows = state.pop(_KEY, None)
        if not self.learns:
            return
        if rows is None or rows.shape != self._rows.shape:
            raise InputError(f"checkpoint: has no exposures of {len(self._rows)} photos: start with --overwrite")
        to_device(self.device, self._exposures, rows.astype(self.kernels.dtype))

    def _download(self) -> NDArray[np.floating]:
        return to_host(self.device, self._exposures, np.empty_like(self._rows))


def needs_photos(config: TrainConfig, channels: int) -> bool:
    """Whether anything stands between renders and truths of so many channels."""
    return config.exposure or channels > 3


def photo_bytes(layout: ImageLayout, itemsize: int, config: TrainConfig, channels: int) -> int:
    """Device memory that `PhotoLoss` takes for images of the layout."""
    return (3 * itemsize + 3) * layout.plane if needs_photos(config, channels) else 0


def exposures_json(names: Sequence[str], exposures: NDArray[np.floating]) -> dict[str, list[list[float]]]:
    """3DGS's exposure.json: by name of the photo, rows [:, :3] transposed (it multiplies colours from the left)."""
    written = np.concatenate([exposures[:, :, :3].transpose(0, 2, 1), exposures[:, :, 3:]], axis=2)
    return dict(zip(names, written.tolist(), strict=True))
