"""The splats of a run on one device, and what makes their gradients of a photo there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..device.device import Device
from ..rendering.build import KernelBuild
from ..rendering.frame import Frame
from ..rendering.pipeline import Pipeline, isect_limit
from ..rendering.splat_buffers import CompactGradients, SplatBuffers
from ..rendering.tuning import schedule_for
from ..scenes.scene import Scene
from ..splats.color import Color
from ..splats.fields import Array
from .config import TrainConfig
from .depth_smoothness import DepthSmoothness
from .dropout import SplatDropout
from .exposure import PhotoLoss
from .exposure_hint import usual_exposures
from .loss import ImageLoss, LossResult
from .loss_check import check_loss
from .memory_estimate import Estimate, room_for_isects, run_memory
from .programs import kernel_build
from .step_check import check_step
from .targets import Target, Targets, target_budget, target_channels


class Replica:
    """The splats of a run on one device, with pipeline, photos and losses.

    Parameters
    ----------
    memory : the estimate of the run's memory on this device.
    first : the splats at the start. capacity : the largest number of splats.
    n_frozen : splats that do not change, the last ones (context.py).
    usual : the photos of usual exposure (`PhotoLoss`); None finds them if exposures are learned.

    Attributes
    ----------
    grads : gradients of the splats, of the photo that was learned last.

    Raises
    ------
    DeviceError : the device has too little memory, or computes the loss or a step wrongly.
    """

    def __init__(
        self,
        device: Device,
        kernels: KernelBuild,
        memory: Estimate,
        scene: Scene,
        config: TrainConfig,
        first: Mapping[str, Array],
        capacity: int,
        n_frozen: int = 0,
        usual: NDArray[np.bool_] | None = None,
    ) -> None:
        self.device, self.kernels, self.scene, self.config = device, kernels, scene, config
        max_isects = min(isect_limit(device, kernels), room_for_isects(memory, device.info))
        self.pipeline = Pipeline(device, kernels, max_isects)
        self.splats = SplatBuffers(device, kernels.schema, capacity, kernels.dtype, n_frozen)
        self.splats.set(first)
        self.grads = CompactGradients(device, self.splats.schema, capacity, kernels.dtype)
        self.loss = ImageLoss(self.pipeline.pool, kernels, config.loss.lambda_dssim, config.loss.smooth_l1)
        check_loss(device, kernels, config.loss.lambda_dssim, config.loss.smooth_l1)
        check_step(device, kernels, config.sghmc.position_optimizer)
        if usual is None and config.appearance.exposure and config.appearance.exposure_rate > 0:
            usual = usual_exposures(scene.train, scene.points)  # before the device has the photos and they are given up
        channels = target_channels(scene.train, config)
        self.targets = Targets(device, kernels, scene.train, target_budget(device), channels)
        self.exposure = PhotoLoss(self.loss, self.targets, config, config.background, usual)
        self.dropout = SplatDropout(config, self.splats)
        self.smoothness = DepthSmoothness(config, kernels, self.splats, scene.train, max_isects)

    @property
    def nbytes(self) -> int:
        """Bytes of device memory of frames, their gradients and the photos."""
        return self.pipeline.pool.nbytes + self.targets.nbytes + self.smoothness.nbytes

    def copy_on(self, device: Device, first: Mapping[str, Array]) -> Replica:
        """Return the same on another device; it has the same schedule, if the device is of the same kind."""
        same = str(self.kernels.schedule) if device.info.name == self.device.info.name else None
        kernels = kernel_build(self.config, schedule_for(device, same))
        memory = run_memory(device, kernels, self.config, self.scene.train)
        capacity, usual = self.splats.capacity, self.exposure.usual
        return Replica(device, kernels, memory, self.scene, self.config, first, capacity, usual=usual)

    def learn(self, target: Target, background: Color, sh_degree: int, iteration: int) -> tuple[Frame, LossResult]:
        """Render a photo's view, and write the gradients of its loss into `grads`, with those of smooth depths.

        Nothing waits for the device.
        """
        frame = self.pipeline.forward(self.splats, target.camera, background, sh_degree, self.dropout.of(iteration))
        result = self.exposure.evaluate(target, frame.images.color.buffer, background)
        self.pipeline.backward(frame, result.v_color, self.grads)
        if self.smoothness.is_due(iteration):
            self.smoothness.add(self.grads, target, self.targets.planes(target), iteration)
        return frame, result
