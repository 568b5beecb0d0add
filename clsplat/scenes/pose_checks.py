"""Poses, lenses and points that can be read but cannot be right. They are named before a run trains to garbage."""

from __future__ import annotations

import filecmp
import warnings
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras.camera import Camera
from ..cameras.seen import sampled, seen
from ..errors import InputError
from ..files.images import image_size, read_image
from .colmap import NO_POINTS, Points
from .extent import together
from .origin import FAR
from .pose_axes import warn_of_convention
from .posed_images import PosedImages

_MAX_POINT = 1e30  # the largest coordinate of a point; float32 ends at 3e38
_MAX_POSITION = 1e12  # training in float32 breaks between this and 1e15
_TOO_FAR = 1e6  # sizes of the scene from the origin: steps of float32 are a twentieth of the scene there
_DIGITS = 9  # poses that agree to these decimals count as equal
_MOST_DECODED = 8  # pairs of photos with equal poses whose pixels are compared, which takes time
_LEAST_FOCAL = 1e-3  # of the side of an image: an angle of view of 179.9 degrees
_WIDEST = 0.05  # focal length by the side of an image: an angle of view of 169 degrees, which no pinhole image has
# From the middle of an image to the principal point, by the side: photos that are cut to three quarters have 0.17.
_OFF_CENTRE = 0.45
_UNEVEN = 2.0  # largest ratio of the focal lengths of a photo that goes without a warning
_SEEN_SHARE = 0.01  # of the points that some image must show
_SHRUNK, _GROWN = 0.21, 1.99  # COLMAP's undistortion scales a side by 0.2 to 2; such sides are at the limits


def check_poses(root: Path, posed: PosedImages, size: float) -> None:
    """Refuse a scene that float32 cannot hold, and warn of poses that cannot be right.

    Parameters
    ----------
    size : of the scene (`origin.size_of`).

    Warns
    -----
    UserWarning : a camera is far from the scene for its size, or different photos have equal poses.

    Raises
    ------
    InputError : a camera is further from the origin than float32 can hold, as such or for the scene's size.
    """
    if posed.photos:
        _check_positions(root, posed, size)
        _warn_of_equal_poses(root, posed)


def without_far_points(root: Path, points: Points) -> Points:
    """Return the points that float32 can hold, and warn if there are others."""
    near = (np.abs(points.xyz) <= _MAX_POINT).all(axis=1)
    if near.all():
        return points
    warnings.warn(
        f"{root}: {int((~near).sum())} of {len(points)} points are further away than {_MAX_POINT:g}; they are left out",
        stacklevel=4,
    )
    return Points(points.xyz[near], points.rgb[near], points.track_length[near])


def without_unseen_points(root: Path, points: Points, cameras: Sequence[Camera]) -> Points:
    """Return the points, or none and a warning if hardly any of them is in an image.

    Such points are not of these poses. Splats that start there would have to be removed again.
    """
    if not len(points):
        return points
    warn_of_convention(root, points, cameras)
    sample = sampled(points.xyz)
    shown = np.zeros(len(sample), np.bool_)
    for camera in cameras:
        shown |= seen(camera, sample).inside
        if shown.mean() >= _SEEN_SHARE:  # mostly after the first camera
            return points
    warnings.warn(
        f"{root}: its photos show {shown.mean():.1%} of its {len(points)} points, so the points do not fit the poses; "
        "they are left out",
        stacklevel=4,
    )
    return NO_POINTS


def warn_of_lone_cameras(root: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Warn about cameras that are far from all others. names : of their photos."""
    near = {id(camera) for camera in together(cameras)}
    lone = [name for name, camera in zip(names, cameras, strict=True) if id(camera) not in near]
    if lone:
        warnings.warn(
            f"{root}: {len(lone)} of {len(names)} photos have a camera far from all others, for example {lone[0]!r}: "
            "check its pose",
            stacklevel=4,
        )


def _check_positions(root: Path, posed: PosedImages, size: float) -> None:
    poses = np.array([photo.cam_from_world for photo in posed.photos])
    distances = np.abs(poses[:, :3, 3]).max(axis=1)  # squares could overflow
    farthest = int(distances.argmax())
    name, distance = posed.names[farthest], float(distances[farthest])
    if distance > _MAX_POSITION:
        raise InputError(
            f"{root}: the translation of {name!r} is {distance:.2g}, more than {_MAX_POSITION:g}; "
            "scale the poses down, or correct this one"
        )
    ratio = distance / size
    if ratio < FAR:
        return
    text = (
        f"{root}: the translation of {name!r} is {distance:.2g}, {ratio:.1g} times the size of the scene ({size:.2g})"
    )
    if ratio >= _TOO_FAR:
        raise InputError(f"{text}, so float32 cannot hold it; correct the pose, or choose another origin")
    warnings.warn(f"{text}; its image loses sharpness in float32. Correct the pose", stacklevel=4)


def _warn_of_equal_poses(root: Path, posed: PosedImages) -> None:
    groups: defaultdict[bytes, list[str]] = defaultdict(list)
    for photo in posed.photos:
        groups[(np.round(photo.cam_from_world, _DIGITS) + 0.0).tobytes()].append(photo.name)
    pairs = [
        (names[0], other)
        for names in groups.values()
        for other in names[1:]
        if not filecmp.cmp(posed.files[names[0]], posed.files[other], shallow=False)
    ]
    if len(pairs) <= _MOST_DECODED:
        pairs = [pair for pair in pairs if not _same_pixels(*(posed.files[name] for name in pair))]
    if pairs:
        warnings.warn(
            f"{root}: {len(pairs)} of {len(posed.photos)} photos have the pose of another photo but show something "
            f"else, for example {pairs[0][1]!r} and {pairs[0][0]!r}; correct their poses",
            stacklevel=4,
        )


def _same_pixels(file: Path, other: Path) -> bool:
    """Return whether two files have the same pixels. Their bytes may differ, by a date for example."""
    try:
        return image_size(file) == image_size(other) and np.array_equal(read_image(file), read_image(other))
    except InputError:  # a damaged photo is reported when it is read
        return False


def check_lenses(root: Path, posed: PosedImages) -> None:
    """Check that every photo has a lens that fits it and can be undistorted, without decoding the photo.

    Warns
    -----
    UserWarning : a lens distorts more than undistortion can follow, or its focal lengths are far from each other. Its
        angle of view is nearly 180 degrees, or its principal point is at a side of the image or outside.

    Raises
    ------
    InputError : a focal length is below a thousandth of its side, or as `RegisteredImage.fit`.
    """
    scales: dict[tuple[object, ...], tuple[float, float]] = {}
    strange, uneven, odd = [], [], []
    for photo in posed.photos:
        lens, (width, height) = photo.lens, posed.sizes[photo.name]
        key = (lens.model, lens.width, lens.height, *lens.params, width, height)
        if key not in scales:  # undistortion takes milliseconds
            camera = photo.fitted_camera(width, height)
            if camera.fx < _LEAST_FOCAL * camera.width or camera.fy < _LEAST_FOCAL * camera.height:
                raise InputError(
                    f"{root}: the focal lengths of {photo.name!r} are {camera.fx:g} and {camera.fy:g} px, too short "
                    f"for an image of {camera.width}x{camera.height} px; correct its lens"
                )
            scales[key] = camera.width / width, camera.height / height
            if not 1 / _UNEVEN < camera.fx / camera.fy < _UNEVEN:
                uneven.append((photo, camera))
            if fault := _fault_of(camera):
                odd.append((photo, fault))
        if min(scales[key]) <= _SHRUNK or min(scales[key]) >= _GROWN:
            strange.append((photo, width, height, scales[key]))
    if uneven:
        photo, camera = uneven[0]
        warnings.warn(
            f"{root}: the focal lengths of {photo.name!r} are {camera.fx:g} and {camera.fy:g} px; pixels are seldom so "
            "far from square. Check its lens",
            stacklevel=3,
        )
    if odd:
        photo, fault = odd[0]
        warnings.warn(
            f"{root}: the lens of {photo.name!r} has {fault}: it is wrong, or of another size of the photos; "
            "correct it",
            stacklevel=3,
        )
    if strange:
        photo, width, height, (across, down) = strange[0]
        values = ", ".join(f"{value:g}" for value in photo.lens.params)
        warnings.warn(
            f"{root}: the lens of {len(strange)} of {len(posed.photos)} photos distorts too much to be undistorted, "
            f"for example that of {photo.name!r}: {width}x{height} px become {width * across:.0f}x{height * down:.0f} "
            f"px. Check its {photo.lens.model.name} parameters ({values})",
            stacklevel=3,
        )


def _fault_of(camera: Camera) -> str:
    """Return words for what no usual pinhole image has: a very wide angle, or a principal point far from its middle."""
    size = f"an image of {camera.width}x{camera.height} px"
    if camera.fx < _WIDEST * camera.width or camera.fy < _WIDEST * camera.height:
        return f"focal lengths of {camera.fx:.3g} and {camera.fy:.3g} px for {size}"
    if max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)) > _OFF_CENTRE:
        return f"its principal point at ({camera.cx:.4g}, {camera.cy:.4g}) px in {size}"
    return ""
