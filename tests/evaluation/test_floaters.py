"""Floaters are measured: which views see a splat, how much of the weight is near cameras, and the gap of PSNR."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import MakeRenderer

from clsplat import activity
from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.contributions import contributions
from clsplat.evaluation.floaters import evenly, mean_psnr, measure_floaters, median_depth
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, load_scene
from clsplat.scenes.view import StoredView, View
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder


@pytest.fixture(scope="module")
def renderer(devices: list[Device], make_renderer: MakeRenderer) -> Renderer:
    return make_renderer(devices[0])


@pytest.fixture(scope="module")
def scene(capture_folder: Path) -> Scene:
    return load_scene(capture_folder)


@pytest.fixture(scope="module")
def splats(model_folder: Path) -> Splats:
    return Splats.load(ModelFolder(model_folder).latest_ply()[0])


def blob(
    scene: Scene, view: int, distance: float, size: float, shape: str = "gaussian", opacity: float = 0.9
) -> Splats:
    """Return one black splat on the optical axis of a training view."""
    camera = scene.train[view].camera
    at = camera.position + distance * camera.rotation[2]
    return Splats.from_points(at[None], [[0.0, 0.0, 0.0]], shape, 0, opacity=opacity, scale_factor=size)


def joined(first: Splats, second: Splats) -> Splats:
    """Return the splats of both; the second has degree 0."""
    arrays, more = first.to_numpy(), first.as_shape(first.shape).select([0] * len(second)).to_numpy()
    more |= {name: values for name, values in second.to_numpy().items() if name != "sh" and name in more}
    more["sh"][:] = 0.0
    more["sh"][:, 0] = second.sh[:, 0]
    return first.with_arrays({name: np.concatenate([values, more[name]]) for name, values in arrays.items()})


def test_weights_of_a_view_sum_to_its_opacity(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    for found, view in zip(contributions(renderer, splats, scene.train), scene.train, strict=True):
        alpha = renderer.render(splats, view.camera).alpha
        assert found.weight.sum() == pytest.approx(alpha.sum(), rel=1e-3)
        assert found.weight.min() >= 0


def test_every_photo_is_reported(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    """A display would repeat what it had before, for minutes."""
    told: list[str] = []
    with activity.listening(told.append):
        measure_floaters(renderer, splats, scene.train)
    n = len(scene.train)
    assert [text for text in told if "floaters" in text] == [
        f"floaters measured in photo {number} of {n}" for number in range(1, n + 1)
    ]


@pytest.mark.parametrize("shape", SHAPES)
def test_black_splats_of_every_shape_have_a_weight(renderer: Renderer, scene: Scene, shape: str) -> None:
    one = blob(scene, 0, 2.0, 0.05, shape)
    (found,) = contributions(renderer, one, scene.train[:1])
    assert found.weight[0] == pytest.approx(renderer.render(one, scene.train[0].camera).alpha.sum(), rel=1e-3)
    assert found.depth[0] == pytest.approx(2.0, abs=1e-5)


def test_hidden_pixels_do_not_count(renderer: Renderer, scene: Scene) -> None:
    one, view = blob(scene, 0, 2.0, 0.1), scene.train[0]
    alpha = renderer.render(one, view.camera).alpha
    left = np.zeros(alpha.shape, bool)
    left[:, : left.shape[1] // 2] = True
    (found,) = contributions(renderer, one, [replace(view, mask=left)])
    assert found.weight[0] == pytest.approx(alpha[left].sum(), rel=1e-3)
    assert found.pixels == alpha.size


def test_only_photos_with_a_mask_are_decoded(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    def fail() -> View:
        raise InputError("a photo is decoded")

    view = scene.train[0]
    (found,) = contributions(renderer, splats, [StoredView(view.name, view.camera, fail, may_hide_pixels=False)], 40)
    (same,) = contributions(renderer, splats, [view], 40)
    assert (found.weight == same.weight).all()
    with pytest.raises(InputError, match="a photo is decoded"):
        list(contributions(renderer, splats, [StoredView(view.name, view.camera, fail, may_hide_pixels=True)]))


def test_photos_that_cannot_be_decoded_are_left_out(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    def fail() -> View:
        raise InputError("a.png: cannot be read")

    first, *others = scene.train
    damaged = StoredView(first.name, first.camera, fail, 1)
    with (
        pytest.warns(UserWarning, match=r"1 of 8 photos are not measured: a\.png"),
        pytest.warns(UserWarning, match=r"1 of 8 photos are not looked at: a\.png"),
    ):
        measured = measure_floaters(renderer, splats, [damaged, *others])
    assert measured == measure_floaters(renderer, splats, others)
    with pytest.warns(UserWarning, match="1 of 2 photos are not looked at: a.png"):
        assert len(list(contributions(renderer, splats, [damaged, others[0]]))) == 1


def test_a_floater_before_a_camera_is_near(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    splats = splats.with_near_plane(0.1)
    before = measure_floaters(renderer, splats, scene.train)
    depth = 1.05 * splats.near_plane
    after = measure_floaters(renderer, joined(splats, blob(scene, 0, depth, 0.08 * depth)), scene.train)
    assert after.near_camera_share > before.near_camera_share + 0.001
    assert after.train_psnr < before.train_psnr


def test_splats_of_fewer_than_three_views_are_counted(renderer: Renderer, scene: Scene) -> None:
    view = scene.train[0]
    turned = view.camera.cam_from_world.copy()
    turned[[0, 2]] *= -1.0  # half a turn about the vertical axis: the splat is behind this camera
    away = replace(view, camera=view.camera.posed(turned))
    one = blob(scene, 0, 2.0, 0.05)
    shares = [measure_floaters(renderer, one, [view] * n + [away] * 3).few_views_share for n in (0, 2, 3)]
    assert shares == [1.0, 1.0, 0.0]


def test_the_gap_is_that_of_the_test_views(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    measured = measure_floaters(renderer, splats, scene.train, test_psnr=20.0)
    train_psnr = mean_psnr(renderer, splats, scene.train)
    assert measured.train_psnr == train_psnr
    assert measured.psnr_gap == train_psnr - 20.0
    assert measured.to_json()["psnr_gap"] == measured.psnr_gap
    assert "psnr_gap" not in measure_floaters(renderer, splats, scene.train).to_json()
    assert f", {20.0 - train_psnr:.2f} dB below the test views" in measured.describe()
    assert ", 5.74 dB above the test views" in replace(measured, psnr_gap=5.74).describe()


def test_a_model_without_splats_has_no_floaters(renderer: Renderer, splats: Splats, scene: Scene) -> None:
    measured = measure_floaters(renderer, splats.select([]), scene.train)
    assert (measured.few_views_share, measured.near_camera_share) == (0.0, 0.0)


def test_the_median_depth_is_that_of_the_weight() -> None:
    assert median_depth(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 5.0])) == 2.0
    assert median_depth(np.array([3.0, 1.0]), np.zeros(2)) == 0.0


def test_views_are_chosen_evenly(scene: Scene) -> None:
    views = [replace(scene.train[0], name=str(number)) for number in range(100)]
    chosen = [int(view.name) for view in evenly(views, 20)]
    assert (chosen[0], chosen[-1], len(set(chosen))) == (0, 99, 20)
    assert evenly(views[:7], 20) == views[:7]
