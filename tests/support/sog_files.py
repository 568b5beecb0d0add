"""SOG files, written from stated bytes of each image."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Images = dict[str, np.ndarray]


def some(n: int, bands: int, seed: int = 0) -> tuple[dict[str, Any], Images]:
    """Random content of images five pixels wide: any bytes are sound splats."""
    rng = np.random.default_rng(seed)
    height = -(-n // 5)
    images = {
        f"{name}.webp": rng.integers(0, 256, (height, 5, 4), dtype=np.uint8)
        for name in ("means_l", "means_u", "quats", "scales", "sh0")
    }
    # Components of at most a quarter, so that their squares sum to less than 1.
    images["quats.webp"][..., :3] = rng.integers(64, 192, (height, 5, 3))
    images["quats.webp"][..., 3] = rng.integers(252, 256, (height, 5))
    codebook = np.linspace(-1, 1, 256).tolist()
    meta: dict[str, Any] = {
        "version": 2,
        "count": n,
        "means": {"mins": [-1, -2, -3], "maxs": [4, 5, 6], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": codebook, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": codebook, "files": ["sh0.webp"]},
    }
    if bands:
        entries, width = 70, (bands + 1) ** 2 - 1
        images["shN_centroids.webp"] = rng.integers(0, 256, (2, 64 * width, 4), dtype=np.uint8)
        images["shN_labels.webp"] = np.zeros((height, 5, 4), np.uint8)
        images["shN_labels.webp"][..., 0] = rng.integers(0, entries, (height, 5))
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": entries, "bands": bands, "codebook": codebook, "files": names}
    for image in images.values():
        image[..., 3] = np.maximum(image[..., 3], 1)
    return meta, images


def encoded(meta: Any, images: Images) -> dict[str, bytes]:
    """Return the files by name."""
    files = {"meta.json": json.dumps(meta).encode()}
    for name, pixels in images.items():
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True)
        files[name] = stream.getvalue()
    return files


def write(path: Path, meta: Any, images: Images) -> None:
    """Write an archive, or the files of a folder beside `path`, its meta.json."""
    files = encoded(meta, images)
    if path.name == "meta.json":
        for name, data in files.items():
            path.with_name(name).write_bytes(data)
        return
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
