"""Views with their photos in memory, one at a time; photos that cannot be decoded are left out."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence

from ..errors import InputError
from ..scenes.scene import View


def decoded(views: Sequence[View], purpose: str, *, only_masked: bool = False) -> Iterator[View]:
    """Return the views with their pixels in memory, each only as long as it is used.

    Parameters
    ----------
    purpose : what is done with the photos, such as "measured".
    only_masked : leave photos as they are, without decoding them, if no mask hides pixels of them.

    Warns
    -----
    UserWarning : a photo cannot be decoded; its view is left out.

    Raises
    ------
    InputError : no photo can be decoded.
    """
    damaged: list[str] = []
    for stored in views:
        try:
            view = stored if only_masked and not stored.may_hide_pixels else stored.loaded()
        except InputError as error:
            damaged.append(str(error))
            continue
        yield view
    if damaged and len(damaged) == len(views):
        raise InputError(f"none of the {len(views)} photos can be used ({damaged[0]})")
    if damaged:
        warnings.warn(f"{len(damaged)} of {len(views)} photos are not {purpose}: {damaged[0]}", stacklevel=3)
