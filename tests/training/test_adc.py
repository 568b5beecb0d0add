"""Adaptive density control (training/density/adc.py) clones, splits, prunes and resets every shape by its rules."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_arrays import ALL_SHAPES, Arrays, random_model

from clsplat.errors import TrainingError
from clsplat.splats import shapes
from clsplat.splats.optical_depth import opacity_names
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import Shape
from clsplat.training.density.adc import MIN_OPACITY, RESET_OPACITY, plan_adc, with_reset
from clsplat.training.density.edit import DensifyEdit
from clsplat.training.density.halves import SPLIT_SHRINK, split_along_axis, twice
from clsplat.training.density.table import HostSplats
from clsplat.training.options.density import SPLITS

EXTENT = 2.0
THRESHOLD = 2e-4


def stats_of(gradient: np.ndarray, depth: np.ndarray | None = None, seen: int = 4) -> np.ndarray:
    """Return statistics with these means."""
    n = len(gradient)
    rows = [gradient * seen, (np.zeros(n) if depth is None else depth) * seen, np.full(n, seen)]
    return np.array(rows, np.float32)


def edited(
    arrays: Arrays, shape: Shape, stats: np.ndarray, cap: int = 10_000, seed: int = 0, **options: float | None
) -> DensifyEdit:
    return plan_adc(
        HostSplats(shape, arrays),
        shape,
        stats,
        np.random.default_rng(seed),
        cap,
        **({"extent": EXTENT, "grad_threshold": THRESHOLD} | options),
    )  # type: ignore[arg-type]


def plain(n: int, scale: float, opacity: float = 0.5) -> Arrays:
    """Equal Gaussians at the origin, longest along y."""
    arrays = random_model(shapes.GAUSSIAN, n, 0, dead=0)
    arrays["mean"][:] = 0
    arrays["log_scale"][:] = np.log(scale) + np.array([-1.0, 0.0, -2.0])
    arrays["opacity_logit"][:] = math.log(opacity / (1 - opacity))
    return arrays


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 120),
    seed=st.integers(0, 10_000),
    dead=st.floats(0, 1),
    spare=st.integers(-20, 150),
    by_axis=st.booleans(),
    turnover=st.sampled_from([0.0, 0.05, 0.5]),
    split=st.sampled_from(SPLITS),
    shape=st.sampled_from(ALL_SHAPES),
)
def test_laws_of_a_plan(
    n: int, seed: int, dead: float, spare: int, by_axis: bool, turnover: float, split: str, shape: Shape
) -> None:
    arrays = random_model(shape, n, seed, dead)
    rng = np.random.default_rng(seed)
    stats = stats_of(*(rng.exponential(scale, n) for scale in (THRESHOLD, 0.1)))
    cap = max(1, n + spare)
    options = {
        "depth_threshold": 0.1 if by_axis else 0.0,
        "dense_size": 0.02,
        "turnover": turnover,
        "split": split,
    }
    edit = edited(arrays, shape, stats, cap, seed, **options)
    again = edited(arrays, shape, stats, cap, seed, **options)
    moved = edit.apply(arrays)
    n_new = len(edit.source)

    assert 1 <= n_new <= max(cap, n)
    assert n_new == n + edit.added - edit.removed
    assert all(len(a) == n_new and np.isfinite(a).all() for a in moved.values())
    assert all(np.array_equal(a, again.apply(arrays)[name]) for name, a in moved.items())
    kept = shape.strength(arrays) >= MIN_OPACITY
    if kept.any() and (
        split == "long-axis" or not by_axis
    ):  # in 3DSGS a side's opacity may be faint: the next action removes it
        assert (shape.strength(moved) >= MIN_OPACITY * (1 - 1e-6)).all()
    # Survivors are first: they keep their order, values and optimizer states. New rows follow without state.
    old = np.flatnonzero(~edit.fresh)
    np.testing.assert_array_equal(old, np.arange(len(old)))
    assert (np.diff(edit.source[old]) > 0).all()
    assert edit.state_source is not None
    for name, array in moved.items():
        np.testing.assert_array_equal(array[old], arrays[name][edit.source[old]])
        state = edit.apply_state(np.ones_like(arrays[name]), name)
        assert (state[old] == 1).all()
        assert (state[len(old) :] == 0).all()


def test_small_ones_are_cloned_in_place_and_large_ones_split() -> None:
    scale = 0.01 * EXTENT
    for factor, cloned in ((0.9, True), (1.1, False)):
        arrays = plain(3, factor * scale)
        edit = edited(arrays, shapes.GAUSSIAN, stats_of(np.array([0, 2, 0]) * THRESHOLD))
        moved = edit.apply(arrays)
        if cloned:
            assert edit.source.tolist() == [0, 1, 2, 1]
            assert edit.fresh.tolist() == [False] * 3 + [True]
            assert all(np.array_equal(moved[name], array[edit.source]) for name, array in arrays.items())
        else:
            assert edit.source.tolist() == [0, 2, 1, 1]
            assert edit.fresh.tolist() == [False] * 2 + [True] * 2
            np.testing.assert_allclose(
                moved["log_scale"][2:], arrays["log_scale"][:2] - math.log(SPLIT_SHRINK), rtol=1e-6
            )
            assert not np.array_equal(moved["mean"][2], moved["mean"][3])


def test_small_and_large_ones_are_split_along_their_longest_axis() -> None:
    for factor in (0.9, 1.1):
        arrays = plain(3, factor * 0.01 * EXTENT)
        edit = edited(arrays, shapes.GAUSSIAN, stats_of(np.array([0, 2, 0]) * THRESHOLD), split="long-axis")
        assert edit.source.tolist() == [0, 2, 1, 1]
        assert edit.fresh.tolist() == [False] * 2 + [True] * 2
        moved, parents = edit.apply(arrays), {name: array[[1]] for name, array in arrays.items()}
        halves = twice(parents) | split_along_axis(parents, shapes.GAUSSIAN, MIN_OPACITY)
        for name, array in halves.items():
            np.testing.assert_array_equal(moved[name][2:], array.astype(np.float32), err_msg=name)
        assert not np.array_equal(moved["mean"][2], moved["mean"][3])


def test_the_mean_gradient_counts_not_the_sum() -> None:
    arrays = plain(2, 1e-3)
    stats = stats_of(np.array([0.9, 1.1]) * THRESHOLD, seen=50)
    assert edited(arrays, shapes.GAUSSIAN, stats).source.tolist() == [0, 1, 1]
    assert edited(arrays, shapes.GAUSSIAN, np.zeros((3, 2))).source.tolist() == [0, 1]  # never visible


def test_halves_are_drawn_from_the_parents_gaussian() -> None:
    arrays = plain(20_000, 0.5)
    arrays["quat"][:] = (0.3, 0.5, -0.7, 0.2)
    arrays["mean"][:] = (1, 2, 3)
    edit = edited(arrays, shapes.GAUSSIAN, stats_of(np.full(20_000, 1.0)), cap=40_000)
    drawn = edit.apply(arrays)["mean"].astype(np.float64)
    assert len(drawn) == 40_000
    r = rotations(arrays["quat"][:1].astype(np.float64))[0]
    sigma = r @ np.diag(np.exp(2.0 * arrays["log_scale"][0])) @ r.T
    np.testing.assert_allclose(drawn.mean(axis=0), (1, 2, 3), atol=5 * 0.5 / 200)
    np.testing.assert_allclose(np.cov(drawn.T), sigma, atol=0.02 * sigma.max())


def test_pruning_by_opacity_and_not_by_size() -> None:
    arrays = plain(4, 1e-3)
    logit = lambda o: math.log(o / (1 - o))  # noqa: E731
    arrays["opacity_logit"][0] = logit(0.9 * MIN_OPACITY)
    arrays["opacity_logit"][1] = logit(1.1 * MIN_OPACITY)
    arrays["log_scale"][2, 1] = math.log(100 * EXTENT)
    assert edited(arrays, shapes.GAUSSIAN, stats_of(np.zeros(4))).source.tolist() == [1, 2, 3]
    # A splat that is too faint is never split.
    loud = stats_of(np.array([1.0, 0.0, 1.0, 0.0]))
    assert edited(arrays, shapes.GAUSSIAN, loud).source.tolist() == [1, 3, 2, 2]


def test_two_sided_splats_live_by_their_stronger_side_and_signed_ones_by_the_absolute() -> None:
    arrays = random_model(shapes.HALF_GAUSSIAN, 2, 0, dead=0)
    arrays["opacity_logit"][:], arrays["opacity_minus_logit"][:] = -9, (2, -9)
    assert edited(arrays, shapes.HALF_GAUSSIAN, stats_of(np.zeros(2))).source.tolist() == [0]
    arrays = random_model(shapes.STUDENT_T, 2, 0, dead=0)
    arrays["opacity_logit"][:] = (-0.5, -1e-3)
    assert edited(arrays, shapes.STUDENT_T, stats_of(np.zeros(2))).source.tolist() == [0]


@pytest.mark.parametrize("scale", [1e-3, 0.1])
def test_the_cap_holds_exactly_and_the_largest_gradients_come_first(scale: float) -> None:
    gradient = np.array([3, 9, 5, 0, 7, 2]) * THRESHOLD
    arrays = plain(6, scale)
    edit = edited(arrays, shapes.GAUSSIAN, stats_of(gradient), cap=8)
    assert len(edit.source) == 8
    assert np.flatnonzero(np.bincount(edit.source) == 2).tolist() == [1, 4]
    for cap in (1, 6):
        assert edited(arrays, shapes.GAUSSIAN, stats_of(gradient), cap=cap).source.tolist() == list(range(6))
    # Pruning frees rows for densification in the same action.
    arrays["opacity_logit"][3] = -9
    assert len(edited(arrays, shapes.GAUSSIAN, stats_of(gradient), cap=6).source) == 6


@pytest.mark.parametrize("scale", [1e-3, 0.1])  # clones, and splits
def test_at_the_cap_the_faintest_make_room_for_the_largest_gradients(scale: float) -> None:
    gradient = np.array([3, 9, 0, 0, 7, 0]) * THRESHOLD
    arrays = plain(6, scale)
    arrays["opacity_logit"][:] = (1, 2, 0, -1, 3, 2)
    plan = lambda turnover, cap=6, of=gradient: edited(  # noqa: E731
        arrays, shapes.GAUSSIAN, stats_of(of), cap=cap, turnover=turnover
    )
    assert plan(0.0).source.tolist() == list(range(6))
    assert np.bincount(plan(0.17).source).tolist() == [1, 2, 1, 0, 1, 1]  # one of six
    assert np.bincount(plan(0.34).source).tolist() == [1, 2, 0, 0, 2, 1]
    assert np.bincount(plan(0.5).source, minlength=6).tolist() == [0, 2, 0, 0, 2, 1]  # row 0 asks, but is faint itself
    # Nothing is pruned that no gradient asks for, or that the cap has room for. A larger model than the cap stays.
    assert plan(0.5, of=0 * gradient).source.tolist() == list(range(6))
    assert np.bincount(plan(0.5, of=np.array([0, 9, 0, 0, 0, 0]) * THRESHOLD).source).tolist() == [1, 2, 1, 0, 1, 1]
    assert np.bincount(plan(0.5, cap=8).source).tolist() == [2, 2, 1, 0, 2, 1]
    assert np.bincount(plan(0.5, cap=9).source).tolist() == [2, 2, 1, 1, 2, 1]
    assert plan(0.5, cap=5).source.tolist() == list(range(6))


def test_what_is_not_finite_goes_and_the_model_is_never_empty() -> None:
    arrays = plain(5, 1e-3, opacity=1e-3)  # all faint
    assert edited(arrays, shapes.GAUSSIAN, stats_of(np.ones(5))).source.tolist() == list(range(5))
    arrays["sh"][2, 1, 0], arrays["log_scale"][4, 0] = np.nan, np.inf
    assert edited(arrays, shapes.GAUSSIAN, stats_of(np.ones(5))).source.tolist() == [0, 1, 3]
    stats = stats_of(np.array([0, np.nan, 0, np.inf, 0]))
    assert edited(arrays, shapes.GAUSSIAN, stats).source.tolist() == [0, 1, 3]
    arrays["mean"][:] = np.inf
    with pytest.raises(TrainingError, match="no splat has finite parameters"):
        edited(arrays, shapes.GAUSSIAN, stats)
    empty = {name: array[:0] for name, array in plain(1, 1.0).items()}
    assert len(edited(empty, shapes.GAUSSIAN, np.zeros((3, 0))).source) == 0


@pytest.mark.parametrize(("gradient", "depth"), [(0.0, 2.0), (2.0, 0.0)])
@pytest.mark.parametrize("scale", [1e-3, 0.1])
def test_either_gradient_splits_along_the_longest_axis_and_keeps_mean_and_variance(
    gradient: float, depth: float, scale: float
) -> None:
    arrays = plain(1, scale)
    arrays["quat"][:] = (0.3, 0.5, -0.7, 0.2)
    arrays["mean"][:] = (0.1, 0.2, 0.3)
    stats = stats_of(np.array([gradient * THRESHOLD]), np.array([depth * 0.1]))
    if not gradient:
        assert edited(arrays, shapes.GAUSSIAN, stats).source.tolist() == [0]  # not densified
    moved = edited(arrays, shapes.GAUSSIAN, stats, depth_threshold=0.1).apply(arrays)
    r = rotations(arrays["quat"].astype(np.float64))[0]

    def covariance(log_scale: np.ndarray) -> np.ndarray:
        return r @ np.diag(np.exp(2.0 * log_scale.astype(np.float64))) @ r.T

    means = moved["mean"].astype(np.float64)
    assert len(means) == 2
    np.testing.assert_allclose(means.mean(axis=0), arrays["mean"][0], atol=1e-7)
    along = (means[0] - means[1]) @ r / scale
    np.testing.assert_allclose(along, (0, 1, 0), atol=1e-3)
    between = np.einsum("ni,nj->ij", means - means.mean(axis=0), means - means.mean(axis=0)) / 2
    within = np.mean([covariance(s) for s in moved["log_scale"]], axis=0)
    np.testing.assert_allclose(within + between, covariance(arrays["log_scale"][0]), rtol=1e-4, atol=1e-5 * scale**2)
    np.testing.assert_array_equal(moved["opacity_logit"], arrays["opacity_logit"][[0, 0]])


@pytest.mark.parametrize(
    "shape", [shapes.SKEW_NORMAL, shapes.SKEW_NORMAL_DIRECT, shapes.BISECTED_SKEW], ids=lambda s: s.name
)
def test_halves_of_a_skewed_splat_keep_the_skew_across_the_axis_and_half_of_it_along(shape: Shape) -> None:
    arrays = random_model(shape, 1, 3, dead=0)
    arrays["log_scale"][:] = np.log([0.1, 0.3, 0.2])
    stats = stats_of(np.ones(1), np.ones(1))
    moved = edited(arrays, shape, stats, depth_threshold=0.1).apply(arrays)
    np.testing.assert_allclose(moved["skew"], arrays["skew"][[0, 0]] * (1, 0.5, 1), rtol=1e-6)


@pytest.mark.parametrize("depth_threshold", [0.0, 0.1])
def test_the_centroid_of_the_direct_form_stays(depth_threshold: float) -> None:
    """The stored location is not the centroid. Halves that kept the location would shift the learned splat."""
    shape = shapes.SKEW_NORMAL_DIRECT
    arrays = {name: np.repeat(array, 20_000, axis=0) for name, array in random_model(shape, 1, 3, dead=0).items()}

    def centroid(of: Arrays) -> np.ndarray:
        skew = of["skew"].astype(np.float64)
        delta = skew / np.sqrt(1 + np.sum(skew**2, axis=1, keepdims=True))
        local = math.sqrt(2 / math.pi) * np.exp(of["log_scale"]) * delta
        return of["mean"] + np.einsum("nij,nj->ni", rotations(of["quat"].astype(np.float64)), local)

    stats = stats_of(np.ones(20_000), np.ones(20_000))
    halves = edited(arrays, shape, stats, 40_000, depth_threshold=depth_threshold).apply(arrays)
    scale = float(np.exp(arrays["log_scale"].max()))
    shift = np.linalg.norm((centroid(halves).mean(axis=0) - centroid(arrays)[0]) / scale)
    assert shift < (1e-6 if depth_threshold else 5 * 2 / 200)


def test_the_depth_threshold_does_not_depend_on_the_scenes_units() -> None:
    for extent, count in ((0.9, 1), (1.1, 2)):
        stats = stats_of(np.zeros(1), np.full(1, 0.1))
        edit = edited(plain(1, 1e-3), shapes.GAUSSIAN, stats, depth_threshold=0.1, extent=extent)
        assert len(edit.source) == count


@pytest.mark.parametrize("options", [{"depth_threshold": 1e300}, {"grad_threshold": 1e300}])
def test_nothing_exceeds_a_threshold_beyond_single_precision(options: dict[str, float]) -> None:
    """And no warning of an overflow is printed."""
    stats = stats_of(np.ones(1), np.ones(1)).astype(np.float32)
    with np.errstate(over="raise"):
        edit = edited(plain(1, 1e-3), shapes.GAUSSIAN, stats, **{"grad_threshold": 1e30, **options})
    assert len(edit.source) == 1


def opacities(shape: Shape, arrays: Arrays) -> np.ndarray:
    return np.array([shape.opacity(arrays[name].astype(np.float64)) for name in opacity_names(arrays)]).T


@pytest.mark.parametrize("facing", [1.0, -1.0])
def test_a_half_beyond_the_plane_takes_that_sides_opacity(facing: float) -> None:
    shape = shapes.HALF_GAUSSIAN
    arrays = random_model(shape, 1, 0, dead=0)
    arrays["log_scale"][:] = np.log([0.1, 0.3, 0.2])
    arrays["opacity_logit"][:], arrays["opacity_minus_logit"][:] = 2.0, -1.0
    plus, minus = opacities(shape, arrays)[0]
    stats = stats_of(np.ones(1), np.ones(1))

    def halves(normal: tuple[float, float, float]) -> np.ndarray:
        arrays["normal"][:] = normal
        return opacities(shape, edited(arrays, shape, stats, depth_threshold=0.1).apply(arrays))

    # The first half lies at +s/2 along y. That is the plane's + side if the normal points there.
    own = [[plus, plus], [minus, minus]]
    np.testing.assert_allclose(halves((0, 3 * facing, 0)), own if facing > 0 else own[::-1], rtol=1e-6)
    np.testing.assert_allclose(halves((1, 0, 2)), [[plus, minus]] * 2, rtol=1e-6)  # the plane contains the axis
    slanted = halves((1, facing, 0))
    assert (slanted >= minus * (1 - 1e-6)).all()
    assert (slanted <= plus * (1 + 1e-6)).all()
    assert (slanted.sum(axis=1)[0] > slanted.sum(axis=1)[1]) == (facing > 0)


def test_a_soft_plane_without_skew_leaves_both_opacities() -> None:
    shape = shapes.BISECTED_SKEW
    arrays = random_model(shape, 1, 0, dead=0)
    arrays["skew"][:] = 0
    moved = edited(arrays, shape, stats_of(np.ones(1), np.ones(1)), depth_threshold=0.1).apply(arrays)
    np.testing.assert_allclose(opacities(shape, moved), opacities(shape, arrays)[[0, 0]], rtol=1e-6)


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda s: s.name)
def test_a_reset_lowers_opacities_and_their_state_only(shape: Shape) -> None:
    arrays = random_model(shape, 200, 0, dead=0.3)
    for name in opacity_names(arrays):
        arrays[name][:2] = (40.0, 1.0)
    edit = edited(
        arrays, shape, stats_of(np.linspace(0, 2, 200) * THRESHOLD, np.linspace(0, 1, 200)), depth_threshold=0.5
    )
    before = edit.apply(arrays)
    reset = with_reset(edit, HostSplats(shape, arrays), shape)
    after = reset.apply(arrays)
    names = opacity_names(arrays)
    for name, array in after.items():
        if name not in names:
            np.testing.assert_array_equal(array, before[name])
    was, now = opacities(shape, before), opacities(shape, after)
    np.testing.assert_allclose(np.abs(now), np.minimum(np.abs(was), RESET_OPACITY), rtol=1e-5)
    np.testing.assert_array_equal(np.sign(now), np.sign(was))
    assert reset.reset_fields == names
    for name in ("mean", *names):
        state = reset.apply_state(np.ones_like(arrays[name]), name)
        assert state.any() == (name == "mean")
    assert not edit.reset_fields
