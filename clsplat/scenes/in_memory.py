"""Photos that stay in memory while several runs train on them. A single run gives them up once the device has them."""

from __future__ import annotations

from dataclasses import replace

from .read_view import keep_photos
from .scene import Scene

MOST_BYTES = 256 << 20  # of all photos together: more would be missed by the runs


def with_small_photos_in_memory(scene: Scene) -> Scene:
    """Return the scene with the photos of its training views in memory for good, if they are small together.

    Raises
    ------
    InputError : a photo cannot be used.
    """
    if sum(4 * view.camera.width * view.camera.height for view in scene.train) > MOST_BYTES:
        return scene
    keep_photos(scene.train)
    held = {view.name: view.loaded() for view in scene.train}
    return replace(scene, views=[held.get(view.name, view) for view in scene.views])
