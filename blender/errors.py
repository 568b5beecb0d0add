"""From what goes wrong to one line in Blender's report area."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

MISSING = "clsplat is not installed in Blender's Python: see the preferences of the add-on clsplat for the command"


def message_of(error: Exception) -> str | None:
    """What to tell the user, or None for a fault of the add-on's own."""
    if isinstance(error, ImportError):
        return MISSING if (error.name or "").split(".")[0] == "clsplat" else f"{MISSING} ({error.name} is missing)"
    from clsplat.errors import ClsplatError

    if isinstance(error, ClsplatError | OSError):
        return " ".join(str(error).split("\n"))
    return None


def reported(execute: Callable[[Any, Any], set[str]]) -> Callable[[Any, Any], set[str]]:
    """An operator's `execute` that reports what the user can mend, and cancels, instead of raising."""

    @functools.wraps(execute)
    def wrapped(self: Any, context: Any) -> set[str]:  # Blender counts the arguments
        try:
            return execute(self, context)
        except Exception as error:
            message = message_of(error)
            if message is None:
                raise
            self.report({"ERROR"}, message)
            return {"CANCELLED"}

    return wrapped
