"""Check that a scene still has the photos that a model was trained on."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError, Remedy
from .scene import Scene

OPTION = "--allow-changed-photos"


def check_photos(
    scene: Scene, recorded: Mapping[str, Any] | None, model: Path, *, allow: bool = False, all_views: bool = False
) -> None:
    """Raise InputError if photos or masks of a scene differ from those of a run.

    Parameters
    ----------
    scene : the scene as it is now.
    recorded : digest of each photo of the run by name (`Scene.photo_digests`); None for runs that record none.
    model : the model's folder, for the message.
    allow : warn about other contents instead. The set of photos must be the same nevertheless.
    all_views : whether the set of photos must be the same, too.

    Warns
    -----
    UserWarning : the photos have changed, and `allow` is set.
    """
    if not recorded:
        return
    now = scene.photo_digests
    if all_views and recorded.keys() != now.keys():
        gone, added = sorted(recorded.keys() - now.keys()), sorted(now.keys() - recorded.keys())
        raise InputError(
            f"{scene.path}: {len(gone)} photos of {model} are missing and {len(added)} are new, for example "
            f"{(gone + added)[0]!r}: restore the photos, or start again with --overwrite"
        )
    changed = [name for name in sorted(now) if name in recorded and recorded[name] != now[name]]
    if not changed:
        return
    message = (
        f"{scene.path}: {len(changed)} of {len(now)} photos or masks have changed since {model} was trained, for "
        f"example {changed[0]!r}"
    )
    if not allow:
        raise InputError(message, Remedy("restore them"), Remedy("use them anyway", OPTION))
    warnings.warn(message, stacklevel=2)
