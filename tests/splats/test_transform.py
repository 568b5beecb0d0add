"""Splats turned, scaled, moved and joined: what a camera that goes along sees stays the same."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import MakeRenderer
from reference.scenes import for_shape, random_camera
from reference.scenes import random_splats as random_arrays
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.splats.approximate import nearest_gaussians
from clsplat.splats.convert import convert
from clsplat.splats.harmonics import sh_basis
from clsplat.splats.similarity import similarity, turned_harmonics
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined, transformed


def matrix(scale: float = 1.7, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = np.eye(4)
    made[:3, :3] = scale * Rotation.random(rng=rng).as_matrix()
    made[:3, 3] = rng.normal(size=3)
    return made


def random_splats(shape: str, n: int, degree: int) -> Splats:
    return Splats(shape, for_shape(random_arrays(n, n, degree, np.float32), shape))


def along(camera: Camera, given: np.ndarray) -> Camera:
    """The camera after the same map."""
    scale, rotation, translation = similarity(given)
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation @ rotation.T
    pose[:3, 3] = -pose[:3, :3] @ (scale * rotation @ camera.position + translation)
    return camera.posed(pose)


def test_harmonics_turn_with_their_directions() -> None:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rotation = Rotation.random(rng=rng).as_matrix()
    for degree in range(4):
        sh = rng.normal(size=(5, (degree + 1) ** 2, 3))
        before = np.einsum("dk,nkc->ndc", sh_basis(directions, degree), sh)
        turned = turned_harmonics(sh, rotation)
        after = np.einsum("dk,nkc->ndc", sh_basis(directions @ rotation.T, degree), turned)
        np.testing.assert_allclose(after, before, atol=1e-12)


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "half-gaussian"])
def test_images_stay_where_the_camera_goes_along(
    shape: str, devices: list[Device], make_renderer: MakeRenderer
) -> None:
    splats, camera = random_splats(shape, 60, 2), random_camera(0, 70, 50)
    renderer = make_renderer(devices[0], "float32")
    given = matrix()
    before = renderer.render(splats, camera)
    after = renderer.render(transformed(splats, given), along(camera, given))
    assert before.alpha.max() > 0.5
    np.testing.assert_allclose(after.color, before.color, atol=2e-4)
    np.testing.assert_allclose(after.depth, 1.7 * before.depth, rtol=1e-3, atol=1e-3)


def test_similarities_are_read_and_others_refused() -> None:
    scale, rotation, translation = similarity(matrix())
    assert scale == pytest.approx(1.7)
    np.testing.assert_allclose(scale * rotation, matrix()[:3, :3])
    np.testing.assert_array_equal(translation, matrix()[:3, 3])
    stretched = matrix() @ np.diag([1, 1, 2, 1])
    with pytest.raises(InputError, match=r"1\.7, 1\.7, 3\.4"):
        similarity(stretched)
    with pytest.raises(InputError, match="mirrored"):
        similarity(matrix() @ np.diag([1, 1, -1, 1]))
    with pytest.raises(InputError, match="no size"):
        similarity(np.zeros((4, 4)))
    sheared = np.eye(4)
    sheared[:2, 1] = np.sin(0.2), np.cos(0.2)
    with pytest.raises(InputError, match="sheared"):
        similarity(sheared)


def test_joined_models_have_all_splats_and_all_bands() -> None:
    first, second = random_splats("gaussian", 5, 1), random_splats("skew-normal", 7, 3)
    both = joined([first, second])
    assert (len(both), both.shape, both.sh_degree) == (12, "skew-normal", 3)
    np.testing.assert_array_equal(both.skew[:5], 0)
    np.testing.assert_array_equal(both.sh[:5, 4:], 0)
    np.testing.assert_array_equal(both.mean[5:], second.mean)
    assert joined([first]).shape == "gaussian"


def test_the_near_plane_grows_with_the_model_and_a_joined_model_has_the_smallest() -> None:
    splats = random_splats("gaussian", 5, 1).with_near_plane(0.2)
    larger = transformed(splats, np.diag([3.0, 3.0, 3.0, 1.0]))
    assert larger.near_plane == pytest.approx(0.6)
    assert joined([larger, splats]).near_plane == 0.2
    for same in (splats.as_shape("skew-normal"), splats.select([0]), convert(splats, "skew-normal-direct")):
        assert same.near_plane == 0.2
    assert nearest_gaussians(random_splats("skew-normal", 5, 1).with_near_plane(0.2)).near_plane == 0.2
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match=r"near plane .*: give a depth above 0"):
            splats.with_near_plane(wrong)


def test_shapes_without_equals_are_refused() -> None:
    skewed, radial = random_splats("skew-normal", 5, 1), random_splats("student-t", 5, 1)
    with pytest.raises(InputError, match="skew-normal, student-t"):
        joined([skewed, radial])
    peak, none = skewed, Splats("skew-normal", dict(skewed.arrays), "none")
    with pytest.raises(InputError, match="normalised differently"):
        joined([peak, none])
    with pytest.raises(InputError, match="no splats"):
        joined([])
