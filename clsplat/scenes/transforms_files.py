"""Names of the transforms files of nerfstudio, instant-ngp and NeRF's Blender scenes."""

from __future__ import annotations

from pathlib import Path

FILE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"


def find_transforms(path: Path) -> list[Path]:
    """Return the transforms files of a scene: the training and test files, the single file, or an empty list.

    Parameters
    ----------
    path : the scene's folder or a transforms file. `transforms_train.json` includes `transforms_test.json` beside it.
    """
    if path.is_file():
        return find_transforms(path.parent) if path.name == TRAIN else [path]
    pair = [path / TRAIN, path / TEST]
    if pair[0].is_file():
        return [file for file in pair if file.is_file()]
    return [path / FILE] if (path / FILE).is_file() else []
