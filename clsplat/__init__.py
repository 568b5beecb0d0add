"""clsplat: Gaussian and skew-normal splatting on any OpenCL device.

The public names load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ._version import __version__ as __version__

if TYPE_CHECKING:
    from .benchmark.run import run_benchmark
    from .blocks.state import BlocksOptions
    from .blocks.train import BlocksModel, partition_scene, train_in_blocks
    from .cameras.camera import Camera
    from .cameras.make_path import PathRequest
    from .compression.rules import BudgetOptions
    from .compression.search import Budgeted, train_budget
    from .errors import ClsplatError, ClusterError, DeviceError, InputError, OutputError, TrainingError
    from .models.cameras import export_cameras
    from .models.clean import clean_model
    from .models.convert import PageOptions, conversion_cost, convert_model, level_costs
    from .models.detail import DetailLevels
    from .models.evaluation import EvaluationOptions, evaluate, evaluate_models
    from .models.info import inspect
    from .models.lod import ModelLevels, model_levels
    from .models.model import LoadedModel, SceneChoice, load_model
    from .models.prune import prune_model
    from .models.render import ViewChoice, render_views
    from .models.resume import resume
    from .rendering.renderer import Rendered, Renderer
    from .rendering.views import RenderOutput
    from .scenes.demo.make import make_demo_scene, make_large_demo_scene
    from .scenes.reconstruct.reconstruct import reconstruct
    from .scenes.scene import Scene, load_scene
    from .splats.splats import Splats
    from .training.config import TrainConfig
    from .training.progress import TrainingDisplay
    from .training.quality import quality
    from .training.run import Model, train


_HOME = {
    "Camera": "cameras.camera",
    "ClsplatError": "errors",
    "DeviceError": "errors",
    "InputError": "errors",
    "OutputError": "errors",
    "ClusterError": "errors",
    "TrainingError": "errors",
    "Rendered": "rendering.renderer",
    "Renderer": "rendering.renderer",
    "Scene": "scenes.scene",
    "load_scene": "scenes.scene",
    "Splats": "splats.splats",
    "TrainConfig": "training.config",
    "train": "training.run",
    "Model": "training.run",
    "BlocksModel": "blocks.train",
    "BlocksOptions": "blocks.state",
    "BudgetOptions": "compression.rules",
    "Budgeted": "compression.search",
    "partition_scene": "blocks.train",
    "train_budget": "compression.search",
    "train_in_blocks": "blocks.train",
    "TrainingDisplay": "training.progress",
    "quality": "training.quality",
    "LoadedModel": "models.model",
    "SceneChoice": "models.model",
    "load_model": "models.model",
    "EvaluationOptions": "models.evaluation",
    "evaluate": "models.evaluation",
    "evaluate_models": "models.evaluation",
    "RenderOutput": "rendering.views",
    "ViewChoice": "models.render",
    "PathRequest": "cameras.make_path",
    "render_views": "models.render",
    "resume": "models.resume",
    "convert_model": "models.convert",
    "conversion_cost": "models.convert",
    "DetailLevels": "models.detail",
    "ModelLevels": "models.lod",
    "model_levels": "models.lod",
    "level_costs": "models.convert",
    "PageOptions": "models.convert",
    "clean_model": "models.clean",
    "prune_model": "models.prune",
    "inspect": "models.info",
    "export_cameras": "models.cameras",
    "make_demo_scene": "scenes.demo.make",
    "make_large_demo_scene": "scenes.demo.make",
    "reconstruct": "scenes.reconstruct.reconstruct",
    "run_benchmark": "benchmark.run",
}

__all__ = [
    "BlocksModel",
    "BlocksOptions",
    "BudgetOptions",
    "Budgeted",
    "Camera",
    "ClsplatError",
    "ClusterError",
    "DetailLevels",
    "DeviceError",
    "EvaluationOptions",
    "InputError",
    "LoadedModel",
    "Model",
    "ModelLevels",
    "OutputError",
    "PageOptions",
    "PathRequest",
    "RenderOutput",
    "Rendered",
    "Renderer",
    "Scene",
    "SceneChoice",
    "Splats",
    "TrainConfig",
    "TrainingDisplay",
    "TrainingError",
    "ViewChoice",
    "clean_model",
    "conversion_cost",
    "convert_model",
    "evaluate",
    "evaluate_models",
    "export_cameras",
    "inspect",
    "level_costs",
    "load_model",
    "load_scene",
    "make_demo_scene",
    "make_large_demo_scene",
    "model_levels",
    "partition_scene",
    "prune_model",
    "quality",
    "reconstruct",
    "render_views",
    "resume",
    "run_benchmark",
    "train",
    "train_budget",
    "train_in_blocks",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
