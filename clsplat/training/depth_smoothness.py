"""Smooth depths: a penalty on steps of the depth that no edge of a photo explains, in photos and between them.

Few photos leave the depth of a plain wall open, and a run gives each of its splats another one. From a place between
the photos the wall then falls apart. Most surfaces are smooth, so neighbouring pixels should have nearly equal depths
unless the colours differ, too (Niemeyer et al. 2022, RegNeRF, has such a penalty between the photos; Godard et al.
2017, arXiv 1609.03677, weighs it by the edges of a photo). The penalty is in units of the depth, so it is the same for
any size of the scene.

An iteration draws the splats twice more: from the camera of its photo, and from one between two photos. Their colours
are then the depths of their centres, with which the kernels of the renderer draw depths and find the gradient. Planes
need no fine image, so large images of depths are smaller than the photo. A step then counts by the distance of its
pixels in the photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..cameras.between import between
from ..cameras.camera import Camera
from ..device.memory import copy
from ..device.opencl import Buffer
from ..device.program import GROUP_ITEMS
from ..rendering.build import KernelBuild
from ..rendering.frame import DeviceImage, ImageLayout
from ..rendering.pipeline import Pipeline
from ..rendering.splat_buffers import CompactGradients, SplatBuffers
from ..scenes.scene import View
from ..splats.color import BLACK
from ..splats.fields import Group
from .config import TrainConfig
from .dropout import UNTIL
from .programs import depth_program
from .targets import Target, reduced_camera

EDGE = 10.0  # how fast the penalty falls with the difference of two pixels of the photo, 0 to 1
SMALLEST_SIDE = 100  # pixels: images of depths are as small as whole factors allow, but no smaller than this
_ANY_VIEW = 0x6465  # of the random numbers that choose the camera between the photos


class DepthSmoothness:
    """The penalty on the depths of a run. It does nothing with a weight of 0.

    Parameters
    ----------
    kernels : the build of the run. splats : its splats.
    views : the training views.
    max_isects : limit of the isects on the device at once.
    """

    def __init__(
        self, config: TrainConfig, kernels: KernelBuild, splats: SplatBuffers, views: Sequence[View], max_isects: int
    ) -> None:
        self.weight, self.seed = config.views.depth_smoothness, config.seed
        self.last = int(UNTIL * config.iterations) if self.weight else 0
        if not self.last:
            return
        self.shown = splats
        self.between = between([view.camera for view in views])
        device, plain = splats.device, replace(kernels, sh_degree=0)
        self.pipeline, self.program = Pipeline(device, plain, max_isects), depth_program(device, plain)
        self.splats = SplatBuffers(device, plain.schema, splats.capacity, plain.dtype)
        self.grads = CompactGradients(device, plain.schema, splats.capacity, plain.dtype)
        self._v_color = DeviceImage(self.pipeline.pool, plain.dtype, 3)

    @property
    def nbytes(self) -> int:
        """Bytes of device memory of frames and their gradients."""
        return self.pipeline.pool.nbytes if self.last else 0

    def is_due(self, iteration: int) -> bool:
        """Whether an iteration has the penalty: until 0.9 of the run, as dropout."""
        return iteration <= self.last

    def add(self, grads: CompactGradients, target: Target, planes: Buffer, iteration: int) -> None:
        """Add the gradient of the penalty to the geometry in `grads`, without waiting for the device.

        Parameters
        ----------
        target : the photo of the iteration. planes : its pixels.
        """
        self.splats.n = self.shown.n
        copy(self.splats.device, self.shown.geom, self.splats.geom, self.splats.group_bytes(Group.GEOM))
        self._add(grads, target.camera, target, planes, EDGE)
        if self.between:
            chosen = np.random.default_rng((self.seed, _ANY_VIEW, iteration, target.index)).integers(len(self.between))
            self._add(grads, reduced_camera(self.between[chosen], target.downscale), target, planes, 0.0)

    def _add(self, grads: CompactGradients, camera: Camera, target: Target, planes: Buffer, edge: float) -> None:
        """Add the gradient for one camera. If `edge` is above 0, it is that of the photo, and its edges count."""
        splats, n, factor = self.splats, self.splats.n, reduction(camera.width, camera.height)
        camera = reduced_camera(camera, factor)
        axis = dict(zip(("axis_x", "axis_y", "axis_z"), camera.rotation[2].tolist(), strict=True))
        layout = ImageLayout(camera.width, camera.height)
        common = {"capacity": splats.capacity, "n": n, **axis}
        self.program.color_by_depth.over(
            n, GROUP_ITEMS, geom=splats.geom, sh=splats.sh, offset=float(camera.translation[2]), **common
        )
        frame = self.pipeline.forward(splats, camera, BLACK)
        v_color = self._v_color.reserve(layout)
        self.program.smooth_depth.over(
            layout.width,
            GROUP_ITEMS,
            layout.height,
            color=frame.images.color.buffer,
            transmittance=frame.images.transmittance.buffer,
            truth=planes,
            v_color=v_color,
            width=layout.width,
            height=layout.height,
            stride=layout.stride,
            plane=layout.plane,
            photo_stride=target.layout.stride,
            photo_plane=target.layout.plane,
            reduction=factor,
            weight=self.weight / (layout.width * layout.height),
            edge=edge,
        )
        self.pipeline.backward(frame, v_color, self.grads)
        self.program.add_depth_gradient.over(
            n, GROUP_ITEMS, grad_geom=grads.geom, other_geom=self.grads.geom, other_sh=self.grads.sh, **common
        )


def reduction(width: int, height: int) -> int:
    """Return by how much an image of depths is smaller than the photo, in width and in height."""
    return max(min(width, height) // SMALLEST_SIDE, 1)
