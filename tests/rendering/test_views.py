"""The range of depths of a path: quartiles over its frames, so that a frame inside a wall does not stretch it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.errors import InputError
from clsplat.rendering import views
from clsplat.rendering.outputs import ImageWriter
from clsplat.rendering.renderer import Rendered
from clsplat.rendering.views import RenderOutput


def test_the_range_of_a_path_is_between_quartiles_of_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    nears, fars = np.array([1.0, 0.01, 1.2, 1.4, 1.6]), np.array([9.0, 8.0, 500.0, 6.0, 7.0])
    ranges = iter(zip(nears, fars, strict=True))
    monkeypatch.setattr(views, "depth_range", lambda image: next(ranges))
    renderer: Any = SimpleNamespace(render=lambda splats, camera: None)
    splats: Any = None
    cameras = [NamedCamera(str(i), Camera(40, 30, 30.0, 30.0, 20.0, 15.0, np.eye(4))) for i in range(5)]
    assert views.depths_seen(renderer, splats, cameras) == pytest.approx((1.0, 9.0))


def test_extras_that_do_not_exist_are_named() -> None:
    with pytest.raises(InputError, match="extras 'normals': choose one of alpha, depth"):
        RenderOutput("out", extras=("alpha", "normals"))


def test_formats_that_do_not_exist_are_named() -> None:
    with pytest.raises(InputError, match="format 'jpg': choose one of png, npy"):
        RenderOutput("out", format="jpg")


def test_views_in_subfolders_have_a_scale_each(tmp_path: Path) -> None:
    writer = ImageWriter(tmp_path, extras=("depth",))
    for stem, depth in (("a/0001", 4.0), ("b/0001", 5.0)):
        writer.write(stem, Rendered(np.zeros((2, 2, 3)), np.ones((2, 2)), np.full((2, 2), depth, np.float32)))
    assert writer.depth_scales == {"a/0001_depth.png": 4.0, "b/0001_depth.png": 5.0}


def test_depths_below_zero_are_black(tmp_path: Path) -> None:
    """Splats whose opacity has a sign can make them."""
    depth = np.array([[4.0, -1.0], [2.0, 0.0]], np.float32)
    for stem, plane in (("some", depth), ("all", -np.abs(depth) - 1)):
        ImageWriter(tmp_path, extras=("depth",)).write(stem, Rendered(np.zeros((2, 2, 3)), np.ones((2, 2)), plane))
    assert np.asarray(Image.open(tmp_path / "some_depth.png")).tolist() == [[65535, 0], [32768, 0]]
    assert not np.asarray(Image.open(tmp_path / "all_depth.png")).any()
