"""The Blender add-on: splats as objects, rendered by clsplat.

`lens.py` and `pictures.py` do not import `bpy`. The other modules do, so they are imported when Blender registers the
add-on.
"""

from __future__ import annotations


def register() -> None:
    """Called by Blender when the add-on is enabled."""
    from . import registry

    registry.register()


def unregister() -> None:
    """Called by Blender when the add-on is disabled."""
    from . import registry

    registry.unregister()
