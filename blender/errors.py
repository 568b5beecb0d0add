"""Conversion of errors to one line in the report area of Blender."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

MISSING = "clsplat is not installed in Blender's Python: see the preferences of the add-on clsplat for the command"


def message_of(error: Exception) -> str | None:
    """Return the message for the user, or None for a fault of the add-on."""
    if isinstance(error, ImportError):
        return MISSING if (error.name or "").split(".")[0] == "clsplat" else f"{MISSING} ({error.name} is missing)"
    from clsplat.errors import ClsplatError

    if isinstance(error, ClsplatError | OSError):
        return " ".join(str(error).split("\n"))
    return None


def reported(execute: Callable[[Any, Any], set[str]]) -> Callable[[Any, Any], set[str]]:
    """Wrap `execute` of an operator: it reports an error that the user can fix and cancels, instead of raising."""

    @functools.wraps(execute)
    def wrapped(self: Any, context: Any) -> set[str]:  # Blender checks the number of arguments
        try:
            return execute(self, context)
        except Exception as error:
            message = message_of(error)
            if message is None:
                raise
            self.report({"ERROR"}, message)
            return {"CANCELLED"}

    return wrapped
