"""The loss against real photos: exposure compensation, masks, and transparency over random backgrounds.

The exposure of a photo is an affine map from the colours of the render to the colours of the photo, as in 3DGS. It does
not change the background behind a transparent photo, which no camera took. Each time a view is trained, its exposure
moves a fixed fraction towards the least-squares fit of the current render. The mean over the usual views is kept at the
identity, which is also used for novel views. A few much darker or brighter photos are not usual
(`exposure_hint.usual_exposures`): they would move the colours of the whole model. 3DGS learns exposures by Adam
instead; the comparison is in docs/decisions.md. A run that begins with a model begins with the exposures of that model.
Runs without exposures, masks and transparency launch none of these kernels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..device.memory import to_device, to_host
from ..device.opencl import Buffer, KernelArgument
from ..device.program import lane_group
from ..errors import InputError
from ..rendering.frame import DeviceImage, ImageLayout
from ..splats.color import Color
from .config import TrainConfig
from .exposure_file import exposures_of_start
from .loss import ImageLoss, LossResult
from .programs import EXPOSURE_GROUP, EXPOSURE_SUMS, EXPOSURE_VECS, exposure_program
from .targets import Target, Targets

KEY = "exposure"  # key of the optimizer state in a checkpoint
_IDENTITY = np.eye(3, 4)


class PhotoLoss:
    """The loss of renders against training photos, and the exposures of the photos.

    Parameters
    ----------
    background : colour under transparent photos in `targets`.
    usual : whether the exposure of each target is among those whose mean is kept, (views,). None: all are.
    """

    def __init__(
        self,
        loss: ImageLoss,
        targets: Targets,
        config: TrainConfig,
        background: Color,
        usual: NDArray[np.bool_] | None = None,
    ) -> None:
        self.loss, self.targets, self.config, self.background = loss, targets, config, background
        self.device, self.kernels = loss.device, loss.kernels
        self.learns = config.appearance.exposure
        self.usual = np.ones(len(targets.views), np.bool_) if usual is None else usual
        self.in_use = needs_exposure(config, targets.channels)
        if not self.in_use:
            return
        self.program, self._step_group = exposure_program(self.device, self.kernels), EXPOSURE_GROUP
        if self.program.step_exposure.max_group < EXPOSURE_GROUP:
            self.program, self._step_group = exposure_program(self.device, self.kernels, 1), 1
        start = exposures_of_start(config.start.init) if self.learns else {}
        first = np.array([start.get(view.name, _IDENTITY) for view in targets.views])
        self._rows = first.reshape(len(targets.views), -1).astype(self.kernels.dtype)
        self._exposures = self.device.alloc(self._rows.nbytes)
        to_device(self.device, self._exposures, self._rows)
        self._photo = DeviceImage(loss.pool, self.kernels.dtype, 3)
        self._laid_over = DeviceImage(loss.pool, np.dtype(np.uint8), 3)
        self._partial = loss.pool.buffer(self.kernels.dtype, EXPOSURE_SUMS)
        self._parts = 0  # of the latest evaluation, in `_partial`

    def evaluate(self, target: Target, rendered: Buffer, background: Color) -> LossResult:
        """Compute the loss of an image, rendered over `background`, and what the step of the exposure needs."""
        planes = self.targets.planes(target)
        if not self.in_use:
            return self.loss.evaluate(target.layout, rendered, planes)
        layout, channels = target.layout, self.targets.channels
        photo, laid_over = self._photo.reserve(layout), planes
        if channels > 3:  # the photo over the new background
            laid_over = self._laid_over.reserve(layout)
        items = -(-layout.width // (self.kernels.lanes * EXPOSURE_VECS))
        group = min(lane_group(self.device), items)
        shift = [255.0 * (new - old) for new, old in zip(background, self.background, strict=True)]
        common: dict[str, KernelArgument] = {
            "color": rendered,
            "truth": planes,
            "exposures": self._exposures,
            "view": target.index,
            "channels": channels,
            "width": layout.width,
            "height": layout.height,
            "stride": layout.stride,
            "plane": layout.plane,
            **{f"back_{color}": value for color, value in zip("rgb", background, strict=True)},
        }
        self.program.photo_of_render.over(
            items,
            group,
            layout.height,
            photo=photo,
            target=laid_over,
            shift_r=shift[0],
            shift_g=shift[1],
            shift_b=shift[2],
            **common,
        )
        result = self.loss.evaluate(layout, photo, laid_over, target.unmasked)
        self._parts = items * layout.height
        partial = self._partial.reserve(self._parts)
        self.program.photo_of_render_vjp.over(
            items, group, layout.height, v=result.v_color, target=laid_over, partial=partial, **common
        )
        return result

    def step(self, view: int, sums: NDArray[np.floating] | None = None) -> None:
        """Step the exposure of a photo.

        Parameters
        ----------
        view : index of the photo.
        sums : what `sums` returned after the evaluation of the photo; None if it was the latest evaluation here.
        """
        if not self.learns:
            return
        partial, parts = self._partial.buffer, self._parts
        if sums is not None:
            parts = sums.size // EXPOSURE_SUMS
            partial = self._partial.reserve(parts)
            to_device(self.device, partial, sums)
        self.program.step_exposure(
            (self._step_group,),
            (self._step_group,),
            exposures=self._exposures,
            partial=partial,
            parts=parts,
            view=view,
            views=len(self.targets.views),
            held=int(np.count_nonzero(self.usual)) if self.usual[view] else 0,
            rate=self.config.appearance.exposure_rate,
            pull=self.config.appearance.exposure_pull,
        )

    def sums(self) -> NDArray[np.floating] | None:
        """Return what `step` needs of the latest evaluation, after waiting for the device; None without exposures."""
        if not self.learns:
            return None
        sums: NDArray[np.floating] = np.empty(EXPOSURE_SUMS * self._parts, self.kernels.dtype)
        return to_host(self.device, self._partial.buffer, sums)

    def follow(self, other: PhotoLoss) -> None:
        """Take the exposures of all photos from another device."""
        if self.learns:
            to_device(self.device, self._exposures, other._download())

    def exposures(self) -> NDArray[np.floating]:
        """Return the exposures E of all views, (views, 3, 4); the identity if exposures are not learned.

        A photo has the colours E[:, :3] render + E[:, 3].
        """
        if not self.in_use:
            return np.tile(_IDENTITY, (len(self.targets.views), 1, 1))
        return self._download().reshape(-1, 3, 4)

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the state for a checkpoint."""
        return {KEY: self._download()} if self.learns else {}

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from the exposures in `state`, which may have others.

        Raises
        ------
        InputError : the exposures are missing, or belong to another number of photos.
        """
        if not self.learns:
            return
        rows = state.get(KEY)
        if rows is None or rows.shape != self._rows.shape:
            raise InputError(
                f"checkpoint: the exposures of {len(self._rows)} photos are missing: start with --overwrite"
            )
        to_device(self.device, self._exposures, rows.astype(self.kernels.dtype))

    def _download(self) -> NDArray[np.floating]:
        return to_host(self.device, self._exposures, np.empty_like(self._rows))


def needs_exposure(config: TrainConfig, channels: int) -> bool:
    """Whether a run with targets of `channels` planes needs the kernels of exposure, masks and transparency."""
    return config.appearance.exposure or channels > 3


def exposure_bytes(layout: ImageLayout, itemsize: int, config: TrainConfig, channels: int) -> int:
    """Return the device memory of `PhotoLoss` for images of the layout."""
    return (3 * itemsize + 3) * layout.plane if needs_exposure(config, channels) else 0
