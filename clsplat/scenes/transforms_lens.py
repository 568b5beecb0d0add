"""The lens of a frame of a transforms file (nerfstudio.py has the format)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.json_file import MAX_NUMBER, to_real
from .photo_size import MAX_SIDE
from .undistort import Lens, brown_lens, make_lens

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
# COLMAP's other lenses: transforms files have no keys for them.
_COLMAP_ONLY = (
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_FISHEYE", "FOV", "DIVISION", "SIMPLE_DIVISION"),
)
_ANOTHER_WAY = "give the COLMAP model in its place, or undistort the photos first"
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # of nerfstudio's `distortion_params`, in its order
_DEGREES = {"camera_angle_x": "x_fov", "camera_angle_y": "y_fov"}  # angles of instant-ngp in degrees
_NO_PINHOLE = ("latlong", "equirectangular", "orthographic", "ftheta_p0")  # lenses of instant-ngp
_MATRICES = ("intrinsic_matrix", "K")  # lenses as a matrix of 3 x 3 or 4 x 4 numbers: NeuS2, others
_SKEW = 0.25  # largest skew of a lens that is left out [px]


@dataclass(frozen=True, eq=False)
class FrameLens:
    """Reads the lens of a frame.

    Parameters
    ----------
    place : file and frame, for messages.
    of_frame : values of the frame.
    of_file : values for all frames of the file.
    """

    place: str
    of_frame: dict[str, Any]
    of_file: dict[str, Any]

    def read(self, size: tuple[int, int]) -> Lens:
        """Return the lens, with the size [px] in the file, or else the photo's size.

        Raises
        ------
        InputError : a key is missing or unusable, or the lens has no pinhole image. The message names file, frame and
            key.
        """
        width, height = int(self.number("w", size[0])), int(self.number("h", size[1]))
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise InputError(f"{self.place}: w x h is {width} x {height}; both must be 1 to {MAX_SIDE}")
        core = self.core(width, height)
        k1, k2, k3, k4, p1, p2 = self.distortion()
        model = str(self.value("camera_model") or "OPENCV").upper()
        if model in _FISHEYE or self.value("is_fisheye"):
            if p1 or p2:
                raise InputError(f"{self.place}: p1 and p2 of a fisheye lens are not supported; {_ANOTHER_WAY}")
            return make_lens("OPENCV_FISHEYE", width, height, [*core, k1, k2, k3, k4])
        if model in _COLMAP_ONLY:
            raise InputError(f"{self.place}: camera_model {model!r} is not supported here; {_ANOTHER_WAY}")
        if model not in _PERSPECTIVE:
            raise InputError(
                f"{self.place}: camera_model {model!r} has no pinhole image; make perspective views "
                f"first, or use one of {', '.join((*_PERSPECTIVE[:2], _FISHEYE[0]))}"
            )
        for key, value in (("k4", k4), *((key, self.number(key, 0.0)) for key in ("k5", "k6"))):
            if value:
                raise InputError(
                    f"{self.place}: {key} of a perspective lens is not supported; undistort the photos first"
                )
        for key in _NO_PINHOLE:
            if self.value(key):
                raise InputError(f"{self.place}: {key} has no pinhole image; make perspective views first")
        return brown_lens(width, height, core, (k1, k2, k3), (p1, p2))

    def core(self, width: int, height: int) -> list[float]:
        """Return fx, fy, cx and cy [px], of keys of their own or of a matrix."""
        # An angle of the frame itself counts more than focal lengths of all frames.
        known = self.of_frame if "camera_angle_x" in self.of_frame else self.of_file | self.of_frame
        fx = self.focal(known, "fl_x", "camera_angle_x", width)
        fy = self.focal(known, "fl_y", "camera_angle_y", height, fx)
        fx = fy if fx is None else fx
        skew = self.number("sk_x", 0.0)
        if fx is None or fy is None:
            fx, fy, cx, cy, skew = self.lens_matrix()
        else:
            cx, cy = self.number("cx", width / 2), self.number("cy", height / 2)
        if abs(skew) > _SKEW:
            raise InputError(f"{self.place}: the lens has a skew of {skew:g} px; undistort the photos first")
        return [fx, fy, cx, cy]

    def lens_matrix(self) -> tuple[float, float, float, float, float]:
        """Return fx, fy, cx, cy and the skew of a lens that is a matrix [px]."""
        for key in _MATRICES:
            if (value := self.value(key)) is None:
                continue
            try:
                matrix = np.array(value, dtype=np.float64)
            except (OverflowError, TypeError, ValueError):
                matrix = np.empty(0)
            if (
                matrix.shape not in ((3, 3), (3, 4), (4, 4))
                or not np.isfinite(matrix).all()
                or min(matrix[0, 0], matrix[1, 1]) <= 0
            ):
                raise InputError(
                    f"{self.place}: {key} must be 3 x 3 numbers with focal lengths above 0; write it again"
                )
            (fx, skew, cx), (_, fy, cy) = matrix[0, :3], matrix[1, :3]
            return float(fx), float(fy), float(cx), float(cy), float(skew)
        raise InputError(f"{self.place}: has neither fl_x nor camera_angle_x; add the focal length")

    def distortion(self) -> list[float]:
        """Return k1, k2, k3, k4, p1 and p2, from nerfstudio's list of them or from keys of their own."""
        listed = self.value("distortion_params")
        if listed is None:
            return [self.number(key, 0.0) for key in _DISTORTION]
        known = [to_real(value) for value in listed] if isinstance(listed, list) else []
        sound = [value for value in known if value is not None and abs(value) < MAX_NUMBER]
        if not len(known) == len(sound) == len(_DISTORTION):
            raise InputError(
                f"{self.place}: distortion_params is {str(listed)[:40]!r}; it must be the numbers "
                f"{', '.join(_DISTORTION)}"
            )
        return sound

    def focal(
        self, known: Mapping[str, Any], key: str, angle: str, size: int, default: float | None = None
    ) -> float | None:
        """Return the focal length [px] at `key`, or from the angle of view at `angle`, or the default.

        known : the values that may have them.
        """
        degrees = _DEGREES[angle]
        if known.get(key) is not None:
            return self.positive(key)
        if known.get(angle) is None and known.get(degrees) is None:
            return default
        field_of_view = math.radians(self.positive(degrees)) if known.get(angle) is None else self.positive(angle)
        if field_of_view >= math.pi:
            raise InputError(f"{self.place}: {angle} is {field_of_view:g}; an angle of view is below pi")
        return 0.5 * size / math.tan(0.5 * field_of_view)

    def positive(self, key: str) -> float:
        value = self.number(key, 0.0)
        if value <= 0:
            raise InputError(f"{self.place}: {key} is {value:g}; it must be above 0")
        return value

    def number(self, key: str, default: float) -> float:
        value = self.value(key)
        if value is None:
            return default
        real = to_real(value)
        if real is None or not abs(real) < MAX_NUMBER:
            raise InputError(f"{self.place}: {key} is {str(value)[:40]!r}; it must be a number")
        return real

    def value(self, key: str) -> Any:
        """Return the frame's value of `key`, or else the value for all frames."""
        return self.of_frame.get(key, self.of_file.get(key))
