"""`Splats`: round trips, immutability, 3DGS initialisation, and named faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_strategies import Arrays, models, random_arrays

from clsplat.errors import InputError, OutputError
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

IN_FOLDER = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def same(a: Splats, b: Splats) -> None:
    assert (a.shape, a.normalisation, a.sh_degree, len(a)) == (b.shape, b.normalisation, b.sh_degree, len(b))
    for name, values in a.arrays.items():
        assert values.dtype == b.arrays[name].dtype
        np.testing.assert_array_equal(values, b.arrays[name], err_msg=name)


@IN_FOLDER
@given(model=models())
def test_save_then_load_is_the_same(tmp_path: Path, model: tuple[str, str, Arrays]) -> None:
    shape, normalisation, arrays = model
    splats = Splats(shape, arrays, normalisation)
    splats.save(tmp_path / "run" / "a.ply")
    same(Splats.load(tmp_path / "run" / "a.ply"), splats)
    same(Splats(shape, splats.to_numpy(), normalisation), splats)


@settings(max_examples=40, deadline=None)
@given(model=models(), data=st.data())
def test_select_takes_rows(model: tuple[str, str, Arrays], data: st.DataObject) -> None:
    shape, normalisation, arrays = model
    splats = Splats(shape, arrays, normalisation)
    n = len(splats)
    indices = data.draw(st.lists(st.integers(-n, n - 1), max_size=8) if n else st.just([]))
    chosen = splats.select(indices)
    assert len(chosen) == len(indices)
    for name, values in chosen.arrays.items():
        assert values.tolist() == [arrays[name][i].tolist() for i in indices]
    mask = data.draw(st.lists(st.booleans(), min_size=n, max_size=n))
    same(splats.select(np.array(mask, dtype=bool)), splats.select(np.flatnonzero(mask)))
    same(splats.select(np.arange(n)), splats)


@settings(max_examples=20, deadline=None)
@given(model=models())
def test_as_shape(model: tuple[str, str, Arrays]) -> None:
    splats = Splats(*[model[i] for i in (0, 2, 1)])
    same(splats.as_shape(splats.shape), splats)
    if SHAPES[splats.shape].signed and (splats.opacity_logit < 0).any():
        with pytest.raises(
            InputError, match=r"of \d+ splats have negative opacity, which shape gaussian does not support"
        ):
            splats.as_shape("gaussian")
        return
    gaussian = splats.as_shape("gaussian")
    assert "skew" not in gaussian.arrays
    back = gaussian.as_shape("skew-normal")
    assert not back.skew.any()
    same(back.as_shape("gaussian"), gaussian)


@pytest.mark.parametrize("shape", SHAPES)
def test_opacities_keep_their_meaning(shape: str) -> None:
    opacity = np.array([0.003, 0.3, 0.7, 0.999])
    splats = Splats.from_points(np.eye(4)[:, :3], np.zeros((4, 3)), shape="gaussian")
    splats = Splats("gaussian", splats.to_numpy() | {"opacity_logit": SHAPES["gaussian"].raw_opacity(opacity)})
    other = splats.as_shape(shape)
    for name in ("opacity_logit", "opacity_minus_logit"):
        if name in other.arrays:
            np.testing.assert_allclose(SHAPES[shape].opacity(other.arrays[name]), opacity, rtol=1e-5)
    np.testing.assert_allclose(other.as_shape("gaussian").opacity_logit, splats.opacity_logit, rtol=1e-4)
    started = Splats.from_points(np.eye(3), np.zeros((3, 3)), shape=shape, opacity=0.25)
    np.testing.assert_allclose(SHAPES[shape].strength(started.arrays), 0.25, rtol=1e-6)


def test_immutable_and_copied() -> None:
    arrays = random_arrays("skew-normal", 4, 1, seed=0)
    splats = Splats("skew-normal", arrays)
    kept = splats.to_numpy()
    for values in arrays.values():
        values += 1
    for name, values in splats.arrays.items():
        np.testing.assert_array_equal(values, kept[name])
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0
    with pytest.raises(AttributeError):
        splats.mean = arrays["mean"]  # type: ignore[misc]
    with pytest.raises(TypeError):
        splats.arrays["mean"] = arrays["mean"]  # type: ignore[index]
    splats.to_numpy()["mean"][:] = 7
    np.testing.assert_array_equal(splats.mean, kept["mean"])


def test_arrays_may_be_kept_instead_of_copied() -> None:
    """A part of a larger array is copied nevertheless."""
    arrays = random_arrays("skew-normal", 4, 1, seed=0)
    larger = random_arrays("skew-normal", 9, 1, seed=0)["mean"]
    splats = Splats("skew-normal", arrays | {"mean": larger[:4]}, copy=False)
    for name, values in arrays.items():
        assert np.shares_memory(splats.arrays[name], values) == (name != "mean")
        assert values.flags.writeable == (name == "mean")
    assert not np.shares_memory(splats.mean, larger)
    moved = splats.with_near_plane(0.5)
    assert all(moved.arrays[name] is values for name, values in splats.arrays.items()), "they do not change"


def test_real_type_is_kept_only_when_all_are_double() -> None:
    arrays = random_arrays("gaussian", 3, 0, seed=0, dtype=np.float64)
    assert {a.dtype for a in Splats("gaussian", arrays).arrays.values()} == {np.dtype("f8")}
    mixed = arrays | {"mean": arrays["mean"].astype(np.float32)}
    assert {a.dtype for a in Splats("gaussian", mixed).arrays.values()} == {np.dtype("f4")}
    lists = {name: values.tolist() for name, values in arrays.items()}
    assert {a.dtype for a in Splats("gaussian", lists).arrays.values()} == {np.dtype("f4")}
    assert Splats("skew-normal", arrays).skew.dtype == np.float64


def test_missing_own_fields_are_neutral() -> None:
    splats = Splats("skew-normal", random_arrays("gaussian", 3, 2, seed=1))
    assert splats.skew.tolist() == [[0, 0, 0]] * 3
    assert splats.arrays["skew"] is splats.skew
    assert Splats("gaussian", random_arrays("gaussian", 3, 2, seed=1)).skew.tolist() == [[0, 0, 0]] * 3
    assert splats.sh_degree == splats.schema.sh_degree == 2
    assert repr(splats) == "Splats(3 x skew-normal, peak-normalised, SH degree 2)"


def damaged(name: str, value: object, at: tuple[int, ...] | None = None) -> Arrays:
    arrays = random_arrays("skew-normal", 4, 1, seed=2)
    if at is None:
        arrays[name] = value  # type: ignore[assignment]
    else:
        arrays[name][at] = value
    return arrays


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        (damaged("mean", np.nan, (2, 1)), r"mean\[2, 1\]: value is nan"),
        (damaged("sh", np.inf, (3, 2, 0)), r"sh\[3, 2, 0\]: value is inf"),
        (damaged("opacity_logit", -np.inf, (0,)), r"opacity_logit\[0\]: value is -inf"),
        (damaged("quat", 0.0, (1,)), r"quat\[1\]: norm is 0, must be above 0"),
        (damaged("quat", 1e-30, (1,)), r"quat\[1\]: norm is 2e-30"),
        (damaged("quat", 1e30, (1,)), r"quat\[1\]: norm is 2e\+30, must be at most"),
        (damaged("skew", 0.8, (3,)), r"skew\[3\]: norm is 1.38564, must be at most 1.32"),
        (damaged("quat", np.ones((4, 3))), r"'quat' has shape \(4, 3\); expected \(4, 4\)"),
        (damaged("sh", np.ones((4, 5, 3))), r"'sh' has shape \(4, 5, 3\); expected \(4, 4, 3\)"),
        (damaged("sh", np.ones((4, 3))), "'sh' has shape"),
        (damaged("opacity_logit", np.ones((4, 1))), "'opacity_logit' has shape"),
        (damaged("mean", 1.0), "'mean' has shape"),
        (damaged("mean", ["a"]), "'mean' is not an array"),
        (damaged("mean", [[1], [1, 2]]), "'mean' is not an array"),
        (damaged("beta", np.ones(4)), "unknown field 'beta'"),
        ({}, "'mean' is missing"),
    ],
)
def test_faults_are_named(arrays: Arrays, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Splats("skew-normal", arrays)


def test_unknown_names() -> None:
    arrays = random_arrays("gaussian", 1, 0, seed=0)
    with pytest.raises(InputError, match="unknown shape 'cube'"):
        Splats("cube", arrays)
    with pytest.raises(InputError, match="unknown normalisation 'unit'"):
        Splats("gaussian", arrays, "unit")
    with pytest.raises(InputError, match="unknown shape"):
        Splats("gaussian", arrays).as_shape("cube")
    for indices in ([4], [-5], [0.5], [[0]], [True], 0, ["a"]):
        with pytest.raises(InputError, match="select"):
            Splats("gaussian", random_arrays("gaussian", 4, 0, seed=0)).select(indices)


def test_save_where_it_cannot(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        Splats("gaussian", random_arrays("gaussian", 1, 0, seed=0)).save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_from_points_is_3dgs_initialisation() -> None:
    rng = np.random.default_rng(4)
    xyz, rgb = rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3), dtype=np.uint8)
    splats = Splats.from_points(xyz, rgb, opacity=0.2, scale_factor=0.5)
    assert (splats.shape, splats.sh_degree, splats.mean.dtype) == ("skew-normal", 3, np.float32)
    np.testing.assert_array_equal(splats.mean, xyz.astype(np.float32))
    distances = np.sort(np.linalg.norm(xyz[:, None] - xyz[None], axis=2), axis=1)[:, 1:4]
    scale = 0.5 * np.sqrt((distances**2).mean(axis=1))
    np.testing.assert_allclose(np.exp(splats.log_scale), np.repeat(scale[:, None], 3, axis=1), rtol=1e-5)
    np.testing.assert_array_equal(splats.quat, np.tile(np.float32([1, 0, 0, 0]), (20, 1)))
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.opacity_logit)), 0.2, rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * splats.sh[:, 0], rgb / 255.0, atol=1e-6)
    assert not splats.sh[:, 1:].any()
    same(Splats.from_points(xyz, rgb / 255.0, opacity=0.2, scale_factor=0.5), splats)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4])
def test_from_few_or_coincident_points(n: int) -> None:
    splats = Splats.from_points(np.zeros((n, 3)), np.zeros((n, 3), dtype=np.uint8), sh_degree=0)
    assert len(splats) == n
    assert splats.sh.shape == (n, 1, 3)
    expected = 1.0 if n == 1 else np.sqrt(1e-7)
    np.testing.assert_allclose(np.exp(splats.log_scale), np.full((n, 3), expected), rtol=1e-5)


def test_unusable_points_are_named() -> None:
    xyz, rgb = np.zeros((3, 3)), np.zeros((3, 3))
    broken = xyz.copy()
    broken[1, 2] = np.nan
    for call, said in (
        (lambda: Splats.from_points(broken, rgb), r"xyz\[1\]"),
        (lambda: Splats.from_points(xyz, rgb + 200.0), "rgb is out of range"),
        (lambda: Splats.from_points(xyz, (rgb + 256).astype(int)), "rgb is out of range"),
        (lambda: Splats.from_points(xyz, rgb[:2]), r"\(2, 3\) of rgb"),
        (lambda: Splats.from_points(xyz, rgb, opacity=1.0), "opacity=1.0"),
        (lambda: Splats.from_points(xyz, rgb, scale_factor=0.0), "scale_factor=0.0"),
        (lambda: Splats.from_points(xyz, rgb, sh_degree=4), "sh_degree is 4"),
        (lambda: Splats.from_points("a", rgb), "'xyz' is not an array"),
    ):
        with pytest.raises(InputError, match=said):
            call()


def test_first_scales_follow_the_units_of_the_scene() -> None:
    """The floor under the distances of near points gives way where all are near."""
    points = np.random.default_rng(3).normal(size=(60, 3))
    points[1] = points[0]
    colours = np.full((60, 3), 0.5)
    normal, small = (Splats.from_points(points * unit, colours, sh_degree=0) for unit in (1.0, 1e-5))
    np.testing.assert_allclose(small.log_scale, normal.log_scale + np.log(1e-5), rtol=1e-5)


def test_a_low_pass_is_a_number() -> None:
    arrays = random_arrays("gaussian", 3, 0, 1)
    with pytest.raises(InputError, match="low pass a: give a variance"):
        Splats("gaussian", arrays, low_pass="a")  # type: ignore[arg-type]
