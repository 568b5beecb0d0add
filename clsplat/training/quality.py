"""The dial of quality: how long a run takes, and how many splats it may have.

These are the two options that every user needs and nobody can know in advance. Options that are named beside the dial
replace its values.
"""

from __future__ import annotations

from typing import Any

from ..errors import InputError
from .config import OPTIONS

Values = dict[str, Any]

NORMAL = "normal"
QUALITIES: dict[str, Values] = {
    "draft": {"iterations": 2000, "cap_max": 30_000},  # is the scene right? a minute or two on two cores
    NORMAL: {name: OPTIONS[name].default for name in ("iterations", "cap_max")},
    "best": {"iterations": 30_000, "cap_max": 300_000},  # the length of published runs: hours on two cores
}


def quality(name: str, batch: int = 1) -> Values:
    """Return the options of a quality by their names in `TrainConfig`.

    Parameters
    ----------
    name : "draft", "normal" or "best".
    batch : photos in an iteration. All qualities have the same photos in fewer iterations.

    Raises
    ------
    InputError : an unknown quality.
    """
    if name not in QUALITIES:
        raise InputError(f"unknown quality {name!r}: choose one of {', '.join(QUALITIES)}")
    values = QUALITIES[name]
    return values | {"iterations": -(-values["iterations"] // batch)}
