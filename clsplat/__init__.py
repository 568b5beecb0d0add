"""clsplat: Gaussian and skew-normal splatting on any OpenCL device.

The public names load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ._version import __version__ as __version__

if TYPE_CHECKING:
    from .cameras.camera import Camera
    from .compression.rules import BudgetOptions
    from .compression.search import Budgeted, train_budget
    from .errors import ClsplatError, DeviceError, InputError, OutputError, TrainingError
    from .rendering.renderer import Rendered, Renderer
    from .scenes.scene import Scene, load_scene
    from .splats.splats import Splats
    from .training.config import TrainConfig
    from .training.progress import TrainingDisplay
    from .training.run import Model, train


_HOME = {
    "Camera": "cameras.camera",
    "ClsplatError": "errors",
    "DeviceError": "errors",
    "InputError": "errors",
    "OutputError": "errors",
    "TrainingError": "errors",
    "Rendered": "rendering.renderer",
    "Renderer": "rendering.renderer",
    "Scene": "scenes.scene",
    "load_scene": "scenes.scene",
    "Splats": "splats.splats",
    "TrainConfig": "training.config",
    "train": "training.run",
    "Model": "training.run",
    "BudgetOptions": "compression.rules",
    "Budgeted": "compression.search",
    "train_budget": "compression.search",
    "TrainingDisplay": "training.progress",
}

__all__ = [
    "BudgetOptions",
    "Budgeted",
    "Camera",
    "ClsplatError",
    "DeviceError",
    "InputError",
    "Model",
    "OutputError",
    "Rendered",
    "Renderer",
    "Scene",
    "Splats",
    "TrainConfig",
    "TrainingDisplay",
    "TrainingError",
    "load_scene",
    "train",
    "train_budget",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
