"""Compressed PLY files of PlayCanvas, packed from stated shares of each range."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

LIMITS = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLOR_LIMITS = [f"{end}_{name}" for end in ("min", "max") for name in "rgb"]
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


class Packed(NamedTuple):
    """The content of a file.

    Attributes
    ----------
    limits : (chunks, 12 or 18) least and greatest positions and scales, and colours.
    words : (N, 4) packed values. rest : (N, 0 to 45) bytes of the harmonics.
    """

    limits: np.ndarray
    words: np.ndarray
    rest: np.ndarray


def some(n: int, degree: int, seed: int = 0, colors: bool = True) -> Packed:
    """Random content: any words are sound splats."""
    rng = np.random.default_rng(seed)
    chunks = -(-n // 256)
    columns = LIMITS + COLOR_LIMITS * colors
    limits = np.sort(rng.normal(size=(chunks, len(columns) // 6, 2, 3)), axis=2).reshape(chunks, len(columns))
    words = rng.integers(0, 2**32, (n, 4), dtype=np.uint32)
    words[:, 1] &= 0xDFF7FDFF  # components of at most a quarter, so that their squares sum to less than 1
    rest = rng.integers(0, 256, (n, 3 * ((degree + 1) ** 2 - 1)), dtype=np.uint8)
    return Packed(limits.astype("<f4"), words.astype("<u4"), rest)


def write(path: Path, packed: Packed) -> None:
    """Write the file as PlayCanvas does."""
    columns = (LIMITS + COLOR_LIMITS)[: packed.limits.shape[1]]
    head = ["ply", "format binary_little_endian 1.0", f"element chunk {len(packed.limits)}"]
    head += [f"property float {name}" for name in columns]
    head += [f"element vertex {len(packed.words)}", *(f"property uint {name}" for name in WORDS)]
    if packed.rest.size:
        head += [f"element sh {len(packed.rest)}"]
        head += [f"property uchar f_rest_{i}" for i in range(packed.rest.shape[1])]
    body = b"".join(part.tobytes() for part in packed)
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + body)
