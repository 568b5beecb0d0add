"""The initial splats come from the scene's points, respect the cap, and can learn skew."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.splats.approximate import nearest_gaussians
from clsplat.splats.convert import convert
from clsplat.splats.morton import morton_order
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.folder import ModelFolder
from clsplat.training.initialise import RANDOM_POINTS, check_init
from clsplat.training.initialise import initial_splats as initial_splats_of
from clsplat.training.presets import PRESETS, preset

initial_splats = partial(initial_splats_of, opacity=0.5, scale_factor=0.1)


def scene(n_points: int, extent: float = 2.0) -> Any:
    """The parts of a Scene that `initial_splats` reads: points, training cameras around (5, 0, 0), and extent."""
    rng = np.random.default_rng(0)
    views = []
    for x in (4.0, 6.0):
        pose = np.eye(4)
        pose[0, 3] = -x
        views.append(SimpleNamespace(camera=Camera(20, 10, 20, 20, 10, 5, pose), alpha=None))
    points = SimpleNamespace(
        xyz=rng.standard_normal((n_points, 3)),
        rgb=rng.integers(0, 256, (n_points, 3), dtype=np.uint8),
        track_length=np.arange(n_points) % 7,
    )
    return SimpleNamespace(points=points, train=views, extent=extent)


def test_points_become_splats_along_a_curve() -> None:
    source = scene(50)
    splats, message = initial_splats(source, cap=50, sh_degree=2)
    xyz = source.points.xyz
    np.testing.assert_allclose(splats.mean, xyz[morton_order(xyz)], rtol=1e-6)
    assert splats.sh.shape == (50, 9, 3)
    assert splats.shape == "skew-normal"
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.opacity_logit)), 0.5)
    assert message == "50 splats from the scene's points"


def test_scale_factor_and_opacity_are_passed_on() -> None:
    small, _ = initial_splats(scene(30), scale_factor=0.1)
    large, _ = initial_splats(scene(30), scale_factor=1.0, opacity=0.1)
    np.testing.assert_allclose(large.log_scale - small.log_scale, np.log(10), rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-large.opacity_logit)), 0.1, rtol=1e-5)


def test_a_cap_keeps_the_longest_tracks() -> None:
    """Track length alone selects at least half of the points. Points of equal track length are selected by index."""
    source = scene(70)
    splats, message = initial_splats(source, cap=15)
    order = sorted(range(70), key=lambda i: (-source.points.track_length[i], i))
    kept = [int(np.abs(source.points.xyz - mean).sum(1).argmin()) for mean in splats.mean]
    assert len(kept) == len(set(kept)) == 15
    assert set(order[: 15 - 15 // 2]) <= set(kept)
    assert "15 splats" in message
    assert "of 70" in message


def test_a_cap_leaves_no_part_of_the_scene_empty() -> None:
    """A textured mat has all the long tracks. Three distant points with short tracks are kept too."""
    source = scene(103)
    source.points.xyz[:100] *= 0.05
    source.points.xyz[100:] = [[40.0, 0.0, 0.0], [0.0, 40.0, 0.0], [0.0, 0.0, -40.0]]
    source.points.track_length[:] = np.where(np.arange(103) < 100, 9, 2)
    splats, _ = initial_splats(source, cap=20)
    assert len(splats) == 20
    assert (np.abs(splats.mean).max(axis=1) > 39).sum() == 3


def test_points_without_tracks_are_spread_over_the_scene() -> None:
    """The order of a file may be that of a scanner, which begins at one end."""
    source = scene(400)
    source.points.xyz[:] = source.points.xyz[np.argsort(source.points.xyz[:, 0])]
    source.points.track_length[:] = 1
    splats, message = initial_splats(source, cap=100)
    assert len(splats) == 100
    assert "100 splats from the scene's points: spread among 400" in message
    edges = np.quantile(source.points.xyz[:, 0], [0.25, 0.5, 0.75])
    assert np.bincount(np.searchsorted(edges, splats.mean[:, 0]), minlength=4).min() >= 15


@pytest.mark.parametrize(("cap", "is_dense"), [(39, True), (41, False)])
def test_dense_clouds_are_spread_over_the_scene(cap: int, is_dense: bool) -> None:
    """Their longest tracks are all in one place, so they say little about the other places."""
    source = scene(400)
    source.points.xyz[:200] *= 0.01
    source.points.track_length[:] = np.where(np.arange(400) < 200, 9, 2)
    splats, _ = initial_splats(source, cap=cap)
    near = np.abs(splats.mean).max(axis=1) <= np.abs(source.points.xyz[:200]).max()
    assert (near.mean() < 0.3) == is_dense
    assert (near.mean() >= 0.5) != is_dense


@pytest.mark.parametrize(("init", "n_points"), [("random", 50), ("sfm", 0), ("sfm", 3)])
def test_scenes_without_points_start_at_random(init: str, n_points: int) -> None:
    splats, message = initial_splats(scene(n_points), cap=3000, init=init)
    assert len(splats) == 3000
    assert "at random where the cameras look" in message
    assert (f"the scene has {n_points} points" in message) == (init == "sfm")


def test_a_random_start_may_leave_room_under_the_cap() -> None:
    for n_points, init in ((50, "random"), (0, "sfm")):
        for share, count in ((0.1, 30), (0.0, 300), (None, 300)):
            splats, _ = initial_splats(scene(n_points), cap=300, init=init, random_share=share)
            assert len(splats) == count


def test_random_points_have_their_own_limit_and_need_no_extent() -> None:
    splats, _ = initial_splats(scene(0, extent=0.0), shape="gaussian", sh_degree=0, init="random")
    assert len(splats) == RANDOM_POINTS
    assert np.ptp(splats.mean[:, 0]) > 1


def test_the_same_seed_gives_the_same_splats() -> None:
    runs = [
        initial_splats(scene(9), init=init, cap=20, seed=seed)[0] for init in ("random", "sfm") for seed in (1, 1, 2)
    ]
    for a, b, c in (runs[:3], runs[3:]):
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.skew, b.skew)
        assert not np.array_equal(a.skew, c.skew)


def test_fields_start_off_their_stationary_point_in_all_directions() -> None:
    starts = {"skew": 0.1, "normal": 1.0}
    for name, shape in SHAPES.items():
        splats, _ = initial_splats(scene(400), shape=name)
        for field in shape.fields:
            values = splats.arrays[field.name]
            if field.name in starts:
                np.testing.assert_allclose(np.linalg.norm(values, axis=1), starts[field.name], rtol=1e-5)
                assert np.linalg.norm(values.mean(axis=0)) < 0.2 * starts[field.name]
        if "nu" in splats.arrays:
            assert (splats.arrays["nu"] == 100).all(), "SSS starts there"
        if "opacity_minus_logit" in splats.arrays:
            np.testing.assert_array_equal(splats.arrays["opacity_minus_logit"], splats.opacity_logit)
        assert ("skew" in splats.arrays) == splats.skew.any()


def saved(path: Path, shape: str, skew: np.ndarray | None = None, normalisation: str = "peak") -> Splats:
    rng = np.random.default_rng(1)
    arrays = {
        "mean": rng.standard_normal((12, 3)),
        "quat": rng.standard_normal((12, 4)),
        "log_scale": rng.standard_normal((12, 3)),
        "opacity_logit": rng.permutation(np.arange(12.0)),
        "sh": rng.standard_normal((12, 4, 3)),
    }
    if skew is not None:
        arrays["skew"] = skew
    splats = Splats(shape, {name: array.astype(np.float32) for name, array in arrays.items()}, normalisation)
    splats.save(path)
    return splats


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_gaussian_model_becomes_another_shape_and_degree(tmp_path: Path, degree: int) -> None:
    before = saved(tmp_path / "model.ply", "gaussian")
    splats, message = initial_splats(scene(0), sh_degree=degree, init=str(tmp_path / "model.ply"))
    np.testing.assert_array_equal(splats.mean, before.mean)
    shared = min(4, (degree + 1) ** 2)
    np.testing.assert_array_equal(splats.sh[:, :shared], before.sh[:, :shared])
    assert splats.sh.shape == (12, (degree + 1) ** 2, 3)
    assert not splats.sh[:, shared:].any()
    assert splats.skew.any(axis=1).all()
    assert "model.ply" in message


def test_a_model_of_another_shape_keeps_its_images_or_becomes_the_nearest(tmp_path: Path) -> None:
    skew = np.tile([0.0, 0.5, 0.0], (12, 1))
    model = saved(tmp_path / "model.ply", "skew-normal", skew)
    direct = convert(model, "skew-normal-direct")
    direct.save(tmp_path / "direct.ply")
    splats, message = initial_splats(scene(0), init=str(tmp_path / "direct.ply"))
    assert "nearest" not in message
    for name in ("mean", "skew", "log_scale"):
        values = convert(direct, "skew-normal").arrays[name]
        np.testing.assert_allclose(splats.arrays[name], values, rtol=1e-4, atol=1e-5, err_msg=name)
    gaussians, message = initial_splats(scene(0), "gaussian", init=str(tmp_path / "direct.ply"))
    assert message.endswith("as the nearest gaussian splats")
    np.testing.assert_allclose(gaussians.mean, nearest_gaussians(model).mean, rtol=1e-4, atol=1e-5)


def test_a_model_with_negative_opacities_loses_them_for_a_shape_without(tmp_path: Path) -> None:
    arrays = saved(tmp_path / "model.ply", "gaussian").to_numpy()
    raw = np.where(np.arange(12) % 3, 0.8, -0.8)
    Splats("student-t", arrays | {"opacity_logit": raw}).save(tmp_path / "model.ply")
    splats, message = initial_splats(scene(0), "gaussian", init=str(tmp_path / "model.ply"))
    assert len(splats) == 8
    assert "without 4 of negative opacity" in message


def test_a_larger_model_keeps_its_most_opaque_and_its_skew(tmp_path: Path) -> None:
    skew = np.zeros((12, 3))
    skew[:, 1] = np.where(np.arange(12) % 2, 0.5, 0.0)
    before = saved(tmp_path / "model.ply", "skew-normal", skew)
    splats, message = initial_splats(scene(0), cap=5, init=str(tmp_path / "model.ply"))
    keep = np.flatnonzero(before.opacity_logit >= 7)
    np.testing.assert_array_equal(splats.mean, before.mean[keep])
    np.testing.assert_array_equal(splats.skew, before.skew[keep])
    assert "most opaque of 12" in message


def test_a_skewed_model_of_another_normalisation_is_refused(tmp_path: Path) -> None:
    saved(tmp_path / "model.ply", "skew-normal", np.full((12, 3), 0.2), normalisation="pdf")
    with pytest.raises(InputError, match="normalisation is pdf"):
        initial_splats(scene(0), init=str(tmp_path / "model.ply"))
    splats, _ = initial_splats(scene(0), init=str(tmp_path / "model.ply"), normalisation="pdf")
    assert splats.normalisation == "pdf"


@pytest.mark.parametrize(
    ("options", "words"),
    [({"init": "grid"}, "sfm, random"), ({"cap": 0}, "cap 0"), ({"init": "missing.ply"}, "missing.ply")],
)
def test_what_cannot_be_used(options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        initial_splats(scene(10), **options)


def test_points_in_one_place_are_one_splat() -> None:
    source = scene(40)
    source.points.xyz[20:] = source.points.xyz[:20]
    splats, message = initial_splats(source)
    assert message == "20 splats from the scene's points"
    assert len(np.unique(splats.mean, axis=0)) == len(splats) == 20
    source.points.xyz[:] = 1.0
    splats, message = initial_splats(source, cap=30)
    assert "at random" in message
    assert message.endswith("(the scene has 40 points, 1 of them apart): expect less than from good points")


def test_a_scene_before_the_near_plane_is_refused() -> None:
    source = scene(60)
    source.points.xyz[:, 2] = np.abs(source.points.xyz[:, 2]) + 4
    initial_splats(source)
    source.points.xyz *= 1e-3
    for view, x in zip(source.train, (4e-3, 6e-3), strict=True):
        pose = np.eye(4)
        pose[0, 3] = -x
        view.camera = view.camera.posed(pose)
    source.path = "yard"
    with pytest.raises(
        InputError, match=r"^yard: 100% of what its cameras see .* \(0.01 units\): use a smaller"
    ) as got:
        initial_splats(source)
    assert "(--near-plane)" in got.value.for_command(["--near-plane"])
    splats, _ = initial_splats(source, near_plane=1e-3)
    assert splats.near_plane == 1e-3


def test_random_points_are_added_to_those_of_the_scene() -> None:
    """Random points fill a fraction of the cap, and their colours are those of their neighbours."""
    source = scene(60)
    for share, cap, ours, placed in (
        (None, 601, 60, 0),
        (0.5, 100, 50, 50),
        (0.0, 10_000, 60, 0),
        (1.0, 40, 1, 39),
        (0.1, 30, 27, 3),
    ):
        splats, message = initial_splats(source, cap=cap, random_share=share)
        assert len(splats) == ours + placed
        assert (f"{placed} at random" in message) == (placed > 0)
        assert message.startswith(f"{ours} splats from the scene's points")
        known = {tuple(row) for row in np.round(source.points.xyz, 4).astype(np.float32)}
        assert sum(tuple(row) in known for row in np.round(splats.mean, 4)) == ours
        given = {tuple(rgb) for rgb in source.points.rgb}
        assert {tuple(row) for row in np.rint(255 * (0.5 + 0.28209479 * splats.sh[:, 0])).astype(int)} <= given
    with pytest.raises(InputError, match="random_points 2: must be 0 to 1"):
        TrainConfig(random_points=2)
    assert all(preset(name)["random_points"] == 0 for name in PRESETS)


def test_a_model_of_no_splats_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    saved(path, "skew-normal", np.full((12, 3), 0.2)).select(np.arange(0)).save(path)
    with pytest.raises(InputError, match=r"model\.ply: has no splats"):
        initial_splats(scene(0), init=str(path))


@pytest.mark.parametrize("name", ["a.ply", "a.SPZ", "a.splat", "a"])
def test_files_of_any_format_are_a_start(tmp_path: Path, name: str) -> None:
    saved(tmp_path / "model.ply", "gaussian").save(tmp_path / name)
    splats, message = initial_splats(scene(0), shape="gaussian", sh_degree=0, init=str(tmp_path / name))
    assert message == f"12 splats from {tmp_path / name}"
    np.testing.assert_array_equal(splats.mean, Splats.load(tmp_path / name).mean)
    with pytest.raises(InputError, match="choose sfm, random, or the path of a file of splats"):
        initial_splats(scene(0), init="scene")
    with pytest.raises(InputError, match=r"gone.spz: cannot be read"):
        initial_splats(scene(0), init=str(tmp_path / "gone.spz"))


def test_a_model_folder_is_no_start_but_its_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model folder may have the name of another start."""
    for name in ("model", "random"):
        model = ModelFolder(tmp_path / name)
        for iteration in (7, 30):
            model.ply_path(iteration).parent.mkdir(parents=True)
            saved(model.ply_path(iteration), "gaussian")
    monkeypatch.chdir(tmp_path)
    check_init("random")
    assert "at random" in initial_splats(scene(0), init="random")[1]
    with pytest.raises(InputError, match=r"is a model folder: name its file .*iteration_30/point_cloud.ply"):
        initial_splats(scene(0), init=str(tmp_path / "model"))
