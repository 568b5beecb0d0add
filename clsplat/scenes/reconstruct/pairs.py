"""The pairs of photos that structure from motion matches."""

from __future__ import annotations

from collections.abc import Sequence

from .panoramas import face_of, face_pairs
from .photo_files import StagedPhoto

MAX_EXHAUSTIVE = 150  # largest number of photos for which "auto" matches all pairs
_OVERLAP = 10  # number of following photos that each photo of a sequence is matched with
_LOOP = 10  # every 10th photo of a sequence is matched with every other 10th photo, to close loops


def is_sequential(matcher: str, is_video: bool, photos: int) -> bool:
    """Return whether an option `matcher` means neighbours only, for a number of photos or panoramas."""
    return is_video or photos > MAX_EXHAUSTIVE if matcher == "auto" else matcher == "sequential"


def pairs_of(photos: int, sequential: bool) -> list[tuple[int, int]]:
    """Return the pairs to match.

    In a sequence, each photo is matched with its neighbours and with photos 16, 32, 64, ... later. A coarse grid of
    photos is matched with itself.
    """
    if not sequential:
        return [(a, b) for a in range(photos) for b in range(a + 1, photos)]
    offsets = {*range(1, _OVERLAP + 1), *(1 << power for power in range(4, photos.bit_length()))}
    near = {(a, a + offset) for a in range(photos) for offset in offsets if a + offset < photos}
    grid = {(a, b) for a in range(0, photos, _LOOP) for b in range(a + _LOOP, photos, _LOOP)}
    return sorted(near | grid)


def named_pairs(photos: Sequence[StagedPhoto], matcher: str, is_video: bool) -> list[tuple[str, str]]:
    """Return the pairs to match by their names in the working folder.

    Faces of panoramas are matched if their panoramas are a pair.
    """
    units: dict[str, list[StagedPhoto]] = {}
    for photo in photos:
        units.setdefault(photo.source.place.rpartition("/")[2] or photo.staged, []).append(photo)
    members = list(units.values())
    sequential = is_sequential(matcher, is_video, len(members))
    found = []
    for a, b in pairs_of(len(members), sequential):
        one, other = members[a], members[b]
        inner = [(0, 0)]
        if one[0].source.place:
            neighbours = is_video and b - a <= _OVERLAP
            faces = [[face_of(photo.source) for photo in unit] for unit in (one, other)]
            inner = list(face_pairs(faces[0], faces[1], neighbours))
        found += [(one[i].staged, other[j].staged) for i, j in inner]
    return found
