"""The near plane of a model: splats whose centres have a smaller depth are not drawn.

Close to a camera the projection of a splat is far too large, and a single splat can hide all others. The plane belongs
to the model, because training sees no splat that is nearer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError

NEAR_PLANE = 0.01  # of models that name none [world units]

_COMMENT = "clsplat near_plane="  # in a PLY file


def usable_near_plane(depth: float) -> float:
    """Return the depth as a float. Raise InputError if it is not above 0 and finite."""
    if not 0.0 < depth < math.inf:
        raise InputError(f"near plane {depth}: give a depth above 0")
    return float(depth)


def near_plane_comments(depth: float) -> list[str]:
    """Return the comments of a PLY file that keep the near plane to the bit; none if it is the usual one."""
    return [] if depth == NEAR_PLANE else [f"{_COMMENT}{depth!r}"]


def find_near_plane(path: Path, comments: Iterable[str]) -> float:
    """Return the near plane that the comments of a PLY file name. Raise InputError if its depth is unusable."""
    for comment in comments:
        if comment.startswith(_COMMENT):
            try:
                return usable_near_plane(float(comment.removeprefix(_COMMENT)))
            except (ValueError, InputError):
                raise InputError(f"{path}: comment {comment[:80]!r}: give a depth above 0, or remove it") from None
    return NEAR_PLANE
