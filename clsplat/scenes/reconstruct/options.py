"""Options of a reconstruction. This module loads neither pycolmap nor an image library."""

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
PANORAMAS = ("auto", "yes", "no")
N_FRAMES = 120  # default number of frames to take from a video
RECORD = "reconstruct.json"  # file in the scene that records its photos, options and result
MIN_PHOTOS = 3  # smallest number of photos for structure from motion
# Smallest and largest numbers. COLMAP's are C integers.
RANGES = {"max_size": (64, 65_535), "frames": (MIN_PHOTOS, 100_000), "seed": (0, 2**31 - 1)}


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of a reconstruction.

    Parameters
    ----------
    camera_model : COLMAP's name of the lens model.
    camera_mode : which photos share a camera. "auto" groups photos with equal sizes and, by EXIF, equal camera and
        focal length.
    matcher : "exhaustive" matches all pairs of photos; "sequential" matches neighbours by name. "auto" is sequential
        for videos and for more than 150 photos.
    max_size : photos are reduced to this longest side to find features [px]; the scene keeps the photos' size.
    frames : number of frames to take from a video.
    panoramas : "yes": the photos are equirectangular, and are cut into pinhole photos. "auto" cuts photos that are
        twice as wide as high and whose data say so; frames of a video have no such data.
    seed : seed of all random numbers.

    Raises
    ------
    InputError : an option has a bad value.
    """

    camera_model: str = "SIMPLE_RADIAL"
    camera_mode: str = "auto"
    matcher: str = "auto"
    max_size: int = 1600
    frames: int = N_FRAMES
    panoramas: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        allowed_values = {
            "camera_model": CAMERA_MODELS,
            "camera_mode": CAMERA_MODES,
            "matcher": MATCHERS,
            "panoramas": PANORAMAS,
        }
        for name, allowed in allowed_values.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} {getattr(self, name)!r}: use one of {', '.join(allowed)}")
        for name, (minimum, maximum) in RANGES.items():
            if not minimum <= getattr(self, name) <= maximum:
                raise InputError(f"{name} {getattr(self, name)}: must be {minimum} to {maximum}")
