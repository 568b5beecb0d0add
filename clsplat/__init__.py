"""clsplat: Gaussian and skew-normal splatting on any OpenCL device.

The public names load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .camera import Camera
    from .config import TrainConfig
    from .errors import ClsplatError, DeviceError, InputError, OutputError, TrainingError
    from .render import Rendered, Renderer
    from .scene import Scene, load_scene
    from .splats import Splats
    from .train import Model, train

__version__ = "0.1.0"

_HOME = {
    "Camera": "camera", "ClsplatError": "errors", "DeviceError": "errors", "InputError": "errors",
    "OutputError": "errors", "TrainingError": "errors", "Rendered": "render", "Renderer": "render",
    "Scene": "scene", "load_scene": "scene", "Splats": "splats", "TrainConfig": "config", "train": "train",
    "Model": "train",
}

__all__ = [
    "Camera", "ClsplatError", "DeviceError", "InputError", "Model", "OutputError", "Rendered", "Renderer",
    "Scene", "Splats", "TrainConfig", "TrainingError", "load_scene", "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)


class _Package(ModuleType):
    """This package: `clsplat.train` stays the function, though importing the submodule would set it."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
