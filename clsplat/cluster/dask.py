"""The package `distributed`, imported when it is needed, and quiet: clsplat's own lines report what goes wrong."""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path
from typing import Any

from ..errors import InputError
from .address import ClusterAddress

MISSING = "a cluster needs dask.distributed: pip install 'clsplat[cluster]'"
_QUIET = {"distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical"}  # of worker processes


def distributed() -> Any:
    """Return the package `distributed`. Raise InputError if it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import dask
            import distributed as package
    except ImportError:
        raise InputError(MISSING) from None
    dask.config.set(_QUIET)
    for name in ("distributed", *(name for name in logging.root.manager.loggerDict if name.startswith("distributed."))):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return package


def scheduler_address(address: ClusterAddress) -> str:
    """Return the address of a scheduler that is not local.

    Raises
    ------
    InputError : the scheduler file cannot be read, or it is not one.
    """
    if not address.is_file:
        return address.text if "://" in address.text else f"tcp://{address.text}"
    path = Path(address.text)
    try:
        # Reading a pipe could wait for ever.
        found = None if path.is_fifo() else json.loads(path.read_text(encoding="utf-8"))["address"]
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}): "
            f"start a scheduler that writes it: `dask scheduler --scheduler-file {path}`"
        ) from None
    except (ValueError, KeyError, TypeError, RecursionError):
        found = None
    if not isinstance(found, str):
        raise InputError(f"{path}: not a scheduler file: start one: `dask scheduler --scheduler-file {path}`")
    return found
