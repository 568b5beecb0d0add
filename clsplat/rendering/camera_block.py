"""The camera as kernels read it: one list of members for the array here and the struct of cl/camera/pinhole.clh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera

_TANGENT_MARGIN = 0.3  # of the tangent of half the field of view, as in gsplat

CAMERA_MEMBERS = (
    *(f"r{row}{column}" for row in range(3) for column in range(3)),
    *("tx", "ty", "tz"),
    *("fx", "fy", "cx", "cy"),
    *("tan_x_min", "tan_x_max", "tan_y_min", "tan_y_max"),
    *("px", "py", "pz"),
    "near",
)


def camera_block(camera: Camera, near_plane: float) -> NDArray[np.float64]:
    """Values of CAMERA_MEMBERS, in this order; the bounds of the tangents are those of gsplat.

    near_plane : depth below which splats are not drawn [world units].
    """
    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    values = dict(zip(CAMERA_MEMBERS, (*camera.rotation.ravel(), *camera.translation), strict=False))
    values |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    values |= {
        "tan_x_min": -(camera.cx / camera.fx + _TANGENT_MARGIN * tan_x),
        "tan_x_max": (camera.width - camera.cx) / camera.fx + _TANGENT_MARGIN * tan_x,
        "tan_y_min": -(camera.cy / camera.fy + _TANGENT_MARGIN * tan_y),
        "tan_y_max": (camera.height - camera.cy) / camera.fy + _TANGENT_MARGIN * tan_y,
    }
    values |= dict(zip(("px", "py", "pz"), camera.position, strict=True))
    values["near"] = near_plane
    return np.array([values[member] for member in CAMERA_MEMBERS])
