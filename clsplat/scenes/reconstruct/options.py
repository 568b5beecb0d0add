"""How photographs become a scene: the options of a reconstruction, without what it takes to make one."""

from __future__ import annotations

from dataclasses import dataclass

from ...errors import InputError

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "FOV",
)
CAMERA_MODES = ("auto", "single", "per-image", "per-folder")
MATCHERS = ("auto", "exhaustive", "sequential")
FRAMES = 120  # wanted of a video, where it has so many
FEWEST = 3  # photos


@dataclass(frozen=True)
class ReconstructOptions:
    """How photographs become a scene.

    Parameters
    ----------
    camera_model : COLMAP's name of the lens model.
    camera_mode : which photos share a camera; "auto": those of one size and, by EXIF, one camera and focal length.
    matcher : "exhaustive" matches all pairs, "sequential" neighbours by name; "auto": sequential for videos and for
        more than 150 photos.
    max_size : longest side at which features are looked for [px]; the scene keeps the photos' size.
    frames : of a video.
    seed : of all that is random.
    """

    camera_model: str = "SIMPLE_RADIAL"
    camera_mode: str = "auto"
    matcher: str = "auto"
    max_size: int = 1600
    frames: int = FRAMES
    seed: int = 0

    def __post_init__(self) -> None:
        for name, allowed in (("camera_model", CAMERA_MODELS), ("camera_mode", CAMERA_MODES), ("matcher", MATCHERS)):
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} {getattr(self, name)!r}: use one of {', '.join(allowed)}")
        for name, least in (("max_size", 64), ("frames", FEWEST)):
            if getattr(self, name) < least:
                raise InputError(f"{name} {getattr(self, name)}: must be at least {least}")
