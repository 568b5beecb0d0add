"""The file `cfg_args` of 3DGS's model folders: the options of a run as the text of a Python call.

    Namespace(sh_degree=3, source_path='/data/room', images='images', resolution=-1, white_background=False, eval=True)

The text is parsed as a literal and never run.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..splats.color import BLACK, WHITE, Color

_MAX_BYTES = 1 << 16
_KINDS = {"source_path": str, "images": str, "resolution": int, "white_background": bool, "eval": bool}
_DEFAULT_IMAGES = "images"  # 3DGS stores it for scenes without such a folder, too


def read_cfg_args(file: Path) -> tuple[Color, dict[str, Any]]:
    """Return the background and the record of the scene, in the keys of config.json.

    A run with `eval` has no `test_names`: its test views are the scene's usual ones.

    Raises
    ------
    InputError : the file cannot be read, or is not such a text.
    """
    try:
        with file.open("rb") as stream:
            text = stream.read(_MAX_BYTES)
        values = _keywords(text.decode())
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error}); check name and rights") from None
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        raise InputError(f"{file}: is not the text Namespace(...) of 3DGS: restore or remove the file") from None
    for key, kind in _KINDS.items():
        if key in values and type(values[key]) is not kind:
            raise InputError(f"{file}: {key} is {str(values[key])[:80]!r}: restore the file as it was written")
    record: dict[str, Any] = {}
    if values.get("source_path"):
        record["path"] = values["source_path"]
    if values.get("images", _DEFAULT_IMAGES) != _DEFAULT_IMAGES:
        record["images"] = values["images"]
    if "resolution" in values:
        record["resolution"] = values["resolution"]
    if not values.get("eval", False):
        record["test_names"] = []
    return WHITE if values.get("white_background") else BLACK, record


def _keywords(text: str) -> dict[str, Any]:
    """Return the known arguments of `Namespace(...)`; raise ValueError if it is another text."""
    call = ast.parse(text.strip(), mode="eval").body
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        raise ValueError
    return {word.arg: ast.literal_eval(word.value) for word in call.keywords if word.arg in _KINDS}
