"""A hint for pixels that are the same in all photos, which a run learns as a part of the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..scenes.still_pixels import pixels_before_scene

if TYPE_CHECKING:
    from ..scenes.scene import Scene


def frame_hint(scene: Scene) -> str | None:
    """Return a sentence if the photos have pixels that never change, although points of the scene lie there."""
    found = pixels_before_scene(scene.train, scene.points.xyz)
    if found is None:
        return None
    kind = "transparent" if found.is_empty else "the same"
    remedy = (
        "the option alpha=mask leaves them out" if found.is_empty else "leave them out with masks, or crop the photos"
    )
    return f"{found.share:.0%} of the pixels are {kind} in all photos, but points of the scene lie there: {remedy}"
