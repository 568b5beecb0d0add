"""clsplat: Gaussian and skew-normal splatting on any OpenCL device.

The public names load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .budget import Budgeted, train_budget
    from .budget_rules import BudgetOptions
    from .camera import Camera
    from .config import TrainConfig
    from .errors import ClsplatError, DeviceError, InputError, OutputError, TrainingError
    from .progress_display import TrainingDisplay
    from .render import Rendered, Renderer
    from .scene import Scene, load_scene
    from .splats import Splats
    from .training import Model, train

__version__ = "0.1.0"

_HOME = {
    "Camera": "camera", "ClsplatError": "errors", "DeviceError": "errors", "InputError": "errors",
    "OutputError": "errors", "TrainingError": "errors", "Rendered": "render", "Renderer": "render",
    "Scene": "scene", "load_scene": "scene", "Splats": "splats", "TrainConfig": "config", "train": "training",
    "Model": "training", "BudgetOptions": "budget_rules", "Budgeted": "budget", "train_budget": "budget",
    "TrainingDisplay": "progress_display",
}

__all__ = [
    "BudgetOptions", "Budgeted", "Camera", "ClsplatError", "DeviceError", "InputError", "Model", "OutputError",
    "Rendered", "Renderer", "Scene", "Splats", "TrainConfig", "TrainingDisplay", "TrainingError", "load_scene", "train",
    "train_budget",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
