"""The crop box: which splats it contains, what is shown and written, and files that are never replaced."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from reference.scenes import for_shape, random_camera, random_splats

from clsplat.errors import InputError
from clsplat.rendering.colormaps import MODES, to_bytes
from clsplat.rendering.renderer import Renderer
from clsplat.splats.quaternions import rotations
from clsplat.splats.splats import Splats
from clsplat.viewer.crop import CropBox, box_around, quaternion_of, unit_edges
from clsplat.viewer.numbered import save_numbered
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource, coverage


def model(n: int = 40) -> Splats:
    return Splats("skew-normal", for_shape(random_splats(3, n, 3, np.float32), "skew-normal"))


def test_a_box_contains_what_is_between_its_sides() -> None:
    half_turn = math.sqrt(0.5)
    box = CropBox.of((1, 2, 3), (half_turn, 0, 0, half_turn), (2, 4, 6))  # a quarter turn about z: x becomes y
    inside = [(1, 2, 3), (2.9, 2, 3), (1, 2.9, 3), (1, 2, 5.9), (-0.9, 1.1, 0.1)]
    outside = [(3.1, 2, 3), (1, 3.1, 3), (1, 2, 6.1), (1, 0.9, 3)]
    assert box.contains(np.array(inside)).all()
    assert not box.contains(np.array(outside)).any()
    assert not box.contains(np.array([(math.nan, 2, 3)])).any()
    assert box.contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("seed", range(4))
def test_a_rotation_becomes_its_quaternion(seed: int) -> None:
    quat = np.random.default_rng(seed).normal(size=4)
    matrix = rotations(quat[None])[0]
    assert np.allclose(rotations(quaternion_of(matrix)[None])[0], matrix, atol=1e-12)
    assert np.allclose(np.abs(quaternion_of(np.diag([1.0, -1.0, -1.0]))), (0, 1, 0, 0))


def test_the_first_box_is_upright_and_holds_nearly_all() -> None:
    generator = np.random.default_rng(1)
    points = generator.normal(size=(5000, 3)) * (3.0, 2.0, 1.0)
    up = np.array([0.0, 1.0, 1.0])
    box = box_around(np.concatenate([points, [(1e6, 0, 0)]]), up)
    assert np.allclose(box.axes[:, 2], up / math.sqrt(2))
    assert np.linalg.det(box.axes) == pytest.approx(1.0)
    assert 0.95 < box.contains(points).mean() < 1.0
    assert max(box.size) < 20.0, "one splat far away does not stretch it"
    for few in (points[:1], points[:5], points[:0], np.ones((5, 3))):
        assert min(box_around(few, up).size) > 0.0
        assert box_around(few, up).contains(few).all()


@pytest.mark.parametrize(
    "values",
    [
        ((0, 0), (1, 0, 0, 0), (1, 1, 1)),
        ((0, 0, math.nan), (1, 0, 0, 0), (1, 1, 1)),
        ((0, 0, 0), (0, 0, 0, 0), (1, 1, 1)),
        ((0, 0, 0), (1, 0, 0, 0), (1, 0, 1)),
        ((0, 0, 0), (1, 0, 0, 0), (1, -1, 1)),
        ((0, 0, 0), (1, 0, 0, math.inf), (1, 1, 1)),
        ("abc", (1, 0, 0, 0), (1, 1, 1)),
        (None, (1, 0, 0, 0), (1, 1, 1)),
    ],
)
def test_what_is_not_a_box_is_one_line(values: tuple[object, object, object]) -> None:
    with pytest.raises(InputError, match=r"^box: "):
        CropBox.of(*values)  # type: ignore[arg-type]


def test_edges_are_those_of_a_cube() -> None:
    edges = unit_edges()
    assert edges.shape == (12, 2, 3)
    assert np.allclose(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1), 1.0)
    assert len({tuple(sorted(map(tuple, edge.tolist()))) for edge in edges}) == 12


def test_splats_outside_are_hidden_in_every_mode() -> None:
    splats, camera = model(), random_camera(1, 41, 27)
    box = CropBox.of(np.median(splats.mean, axis=0), (1, 0, 0, 0), np.ptp(splats.mean, axis=0) / 2)
    inside = box.contains(splats.mean)
    assert 3 < inside.sum() < 37
    source, alone = ModelSource(splats), ModelSource(splats.select(inside))
    for mode in MODES:
        cropped = source.picture(camera, Settings(mode=mode, crop=box))
        assert np.array_equal(cropped, alone.picture(camera, Settings(mode=mode))), mode
    shown = source.picture(camera, Settings(cap=3, crop=box))
    best = np.flatnonzero(inside)[np.argsort(-coverage(splats)[inside], kind="stable")[:3]]
    assert np.array_equal(shown, to_bytes(Renderer().render(splats.select(np.sort(best)), camera).color))
    everything = CropBox.of((0, 0, 0), (1, 0, 0, 0), (1e9, 1e9, 1e9))
    assert np.array_equal(source.picture(camera, Settings(crop=everything)), source.picture(camera, Settings()))
    nothing = CropBox.of((1e6, 0, 0), (1, 0, 0, 0), (1, 1, 1))
    assert not source.picture(camera, Settings(crop=nothing)).any()


def test_only_a_box_is_a_setting() -> None:
    box = CropBox.of((0, 0, 0), (1, 0, 0, 0), (1, 1, 1))
    cropped = Settings().changed("crop", box, MODES)
    assert cropped.crop == box
    assert cropped.changed("crop", "../../etc/passwd", MODES) == cropped
    assert cropped.changed("crop", None, MODES) == Settings()


def test_numbered_files_replace_nothing(tmp_path: Path) -> None:
    (tmp_path / "cropped_007.ply").write_text("mine")
    (tmp_path / "cropped_x.ply").write_text("mine")

    def write(target: Path) -> None:
        target.write_text("new")

    path = save_numbered(tmp_path, "cropped", ".ply", write)
    assert path.name == "cropped_008.ply"
    assert (tmp_path / "cropped_007.ply").read_text() == "mine"
    assert save_numbered(tmp_path / "none", "a", ".b", lambda target: None).name == "a_001.b"
