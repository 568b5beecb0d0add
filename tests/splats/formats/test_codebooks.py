"""Codebooks and palettes: near the best ones, exact where they can be, and equal for equal inputs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.hierarchy import linkage

from clsplat.splats.formats import codebooks
from clsplat.splats.formats.codebooks import best_levels, nearest_level, palette

pytestmark = pytest.mark.filterwarnings("error")


def level_error(values: np.ndarray, levels: np.ndarray, weights: np.ndarray | None = None) -> float:
    """Weighted mean square of the distance to the nearest level, by comparing all of them."""
    return float(np.average(np.abs(values[:, None] - levels).min(axis=1) ** 2, weights=weights))


def palette_error(rows: np.ndarray, entries: np.ndarray, labels: np.ndarray, weights: np.ndarray) -> float:
    return float(np.sum(weights * np.sum((rows - entries[labels].astype(np.float64)) ** 2, axis=1)))


def optimum(values: np.ndarray, n: int) -> float:
    """Mean squared error of the best n levels, by dynamic programming over all cuts of the sorted values."""
    x = np.sort(values)
    count = np.arange(len(x) + 1.0)
    first, second = (np.concatenate([[0.0], np.cumsum(x**power)]) for power in (1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = second - second[:, None] - (first - first[:, None]) ** 2 / (count - count[:, None])
    cost = np.where(count > count[:, None], cost, np.inf)  # [start, end]
    best = cost[0]
    for _ in range(n - 1):
        best = np.min(best[:, None] + cost, axis=0)
    return float(best[-1] / len(x))


def lloyd_error(values: np.ndarray, levels: np.ndarray) -> float:
    """Mean squared error after Lloyd's method in its plainest form."""
    for _ in range(100):
        place = np.abs(values[:, None] - levels).argmin(axis=1)
        levels = np.array([values[place == i].mean() if (place == i).any() else levels[i] for i in range(len(levels))])
    return level_error(values, levels)


SAMPLES = {
    "normal": lambda rng: rng.normal(size=400),
    "laplace": lambda rng: rng.laplace(size=400),
    "uniform": lambda rng: rng.uniform(size=400),
    "clusters": lambda rng: np.concatenate([rng.normal(i**2, 0.05, 80) for i in range(5)]),
    "outlier": lambda rng: np.append(rng.normal(size=399), 300.0),
}


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize(("n", "factor"), [(4, 1.05), (16, 1.1), (60, 1.35)])
def test_levels_are_near_the_best_ones(name: str, n: int, factor: float) -> None:
    rng = np.random.default_rng(n)
    values = SAMPLES[name](rng)
    levels = best_levels(values, n=n)
    assert levels.shape == (n,)
    assert (np.diff(levels) >= 0).all()
    error = level_error(values, levels)
    assert optimum(values, n) * (1 - 1e-9) <= error <= factor * optimum(values, n)
    assert error <= 1.03 * min(lloyd_error(values, rng.choice(values, n, replace=False)) for _ in range(5))


def test_levels_of_many_numbers_are_better_than_equal_steps_and_nearly_as_good_as_the_limit() -> None:
    """Panter and Dite: the best error of many levels is (integral of p^(1/3))^3 / (12 n^2)."""
    values = np.random.default_rng(0).normal(size=(100_000, 3)).astype(np.float32)
    levels = best_levels(values)
    codes = nearest_level(levels, values)
    assert codes.dtype == np.uint8
    assert codes.shape == values.shape
    error = np.mean((levels[codes] - values) ** 2)
    steps = np.linspace(values.min(), values.max(), 256)
    assert error < 0.6 * np.mean((steps[nearest_level(steps, values)] - values) ** 2)
    assert error < 1.01 * np.pi * 3**0.5 / 2 / 256**2


def test_each_level_is_the_average_of_its_values() -> None:
    rng = np.random.default_rng(1)
    values, weights = rng.normal(size=3000), rng.uniform(0.1, 5.0, 3000)
    levels = best_levels(values, weights, n=20)
    codes = nearest_level(levels, values)
    averages = np.bincount(codes, weights * values) / np.bincount(codes, weights)
    np.testing.assert_allclose(levels, averages, rtol=1e-12)


def test_weights_count_as_repetitions_and_broadcast() -> None:
    rng = np.random.default_rng(2)
    values, times = rng.normal(size=(200, 3)), rng.integers(1, 6, 200)
    np.testing.assert_allclose(
        best_levels(values, times[:, None].astype(float), n=12),
        best_levels(np.repeat(values, times, axis=0), n=12),
        rtol=1e-12,
    )


def test_few_values_are_exact_and_the_last_level_is_repeated() -> None:
    assert best_levels(np.array([[3.0, -1.0], [3.0, 7.0]]), n=5).tolist() == [-1, 3, 7, 7, 7]
    assert best_levels(np.full(9, 2.5), n=3).tolist() == [2.5] * 3
    assert best_levels(np.zeros((0, 3))).tolist() == [0.0] * 256
    values = np.random.default_rng(3).normal(size=256).astype(np.float32)
    np.testing.assert_array_equal(best_levels(values), np.sort(values))


def test_one_absurd_value_costs_one_level() -> None:
    values = np.random.default_rng(4).normal(size=1000)
    levels = best_levels(np.append(values, -1e30), n=33)
    assert levels[0] == pytest.approx(-1e30)
    assert level_error(values, levels) < 1.2 * level_error(values, best_levels(values, n=32))


def test_values_of_one_step_get_one_level() -> None:
    values = np.random.default_rng(5).normal(size=5000)
    levels = best_levels(values, finest=0.125)
    steps = np.rint(values / 0.125)
    averages = [values[steps == step].mean() for step in np.unique(steps)]
    np.testing.assert_allclose(np.unique(levels), averages, rtol=1e-12)
    assert np.abs(levels[nearest_level(levels, values)] - values).max() <= 0.125
    # With more steps than levels, no step is divided: all levels are averages of whole steps.
    few = best_levels(values, finest=0.125, n=10)
    assert (np.diff(few) > 0.06).all()
    assert level_error(values, few) < 1.2 * level_error(values, best_levels(values, n=10))


def test_the_nearest_level_is_that_of_a_search_and_the_first_of_equal_ones() -> None:
    rng = np.random.default_rng(6)
    levels, values = np.sort(rng.normal(size=256)), rng.normal(0.0, 2.0, 2000)
    np.testing.assert_array_equal(nearest_level(levels, values), np.abs(values[:, None] - levels).argmin(axis=1))
    assert nearest_level(np.array([1.0, 2.0, 2.0, 2.0]), np.array([-9.0, 1.9, 2.0, 9.0])).tolist() == [0, 1, 1, 1]


def some_rows(n: int, width: int, seed: int = 0) -> np.ndarray:
    """Rows with a long axis, of different lengths, as harmonics have them."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(width, width)) * 0.7 ** np.arange(width)[:, None]
    return (rng.normal(size=(n, width)) @ axes * rng.exponential(size=(n, 1))).astype(np.float32)


@pytest.mark.parametrize("n", [40, 41, 1000])
def test_a_palette_of_few_different_rows_is_exact(n: int) -> None:
    rows = some_rows(40, 9)
    rows[3] = 0.0
    rows = np.concatenate([rows, rows[np.random.default_rng(1).integers(0, 40, 300)], np.full((1, 9), -0.0)])
    rows = rows.astype(np.float32)
    entries, labels = palette(rows, np.ones(len(rows)), n)
    np.testing.assert_array_equal(entries[labels], rows)
    assert len(entries) == 40
    assert len(np.unique(entries, axis=0)) == 40
    assert labels[:40].tolist() == list(range(40))


def test_a_palette_is_better_than_lloyds_from_random_rows() -> None:
    rows, n = some_rows(2000, 12), 300
    weights = np.random.default_rng(2).uniform(0.1, 3.0, len(rows))
    entries, labels = palette(rows, weights, n)
    assert entries.dtype == np.float32
    assert len(entries) <= n
    rng, x = np.random.default_rng(3), rows.astype(np.float64)
    reference = x[rng.choice(len(x), n, replace=False)]
    for _ in range(20):
        place = ((x[:, None] - reference) ** 2).sum(axis=2).argmin(axis=1)
        for i in np.unique(place):
            reference[i] = np.average(x[place == i], axis=0, weights=weights[place == i])
    assert palette_error(x, entries, labels, weights) < 0.8 * palette_error(x, reference, place, weights)


def test_entries_are_weighted_averages_in_the_order_of_their_rows() -> None:
    rows = some_rows(5000, 9)
    rows[4000:] = rows[:1000]  # equal rows count with the sum of their weights
    weights = np.random.default_rng(4).uniform(0.01, 10.0, len(rows))
    entries, labels = palette(rows, weights, 300)
    assert np.array_equal(np.unique(labels), np.arange(len(entries)))
    first = [int((labels == i).argmax()) for i in range(len(entries))]
    assert first == sorted(first)
    for i in (0, 100, len(entries) - 1):
        average = np.average(rows[labels == i].astype(np.float64), axis=0, weights=weights[labels == i])
        np.testing.assert_allclose(entries[i], average, rtol=1e-4, atol=1e-5)


def test_heavy_rows_have_smaller_errors() -> None:
    rows = some_rows(2000, 9)
    weights = np.where(np.arange(2000) % 2, 100.0, 1.0)
    entries, labels = palette(rows, weights, 200)
    errors = np.sum((rows - entries[labels]) ** 2, axis=1)
    assert errors[1::2].mean() < 0.3 * errors[::2].mean()


def test_one_entry_is_the_average_of_all_rows() -> None:
    rows = some_rows(3000, 6)
    weights = np.random.default_rng(5).uniform(0.5, 2.0, 3000)
    entries, labels = palette(rows, weights, 1)
    np.testing.assert_allclose(entries, [np.average(rows.astype(np.float64), axis=0, weights=weights)], rtol=1e-4)
    assert not labels.any()


def test_merges_are_those_of_ward() -> None:
    """SciPy's heights are sqrt(2 m n / (m + n)) times the distance of the averages of m and n rows."""
    rows = some_rows(150, 5)
    kept, gone, added = codebooks._merges(np.arange(150), rows, np.ones(150, np.float32))
    np.testing.assert_allclose(np.sort(2.0 * np.sqrt(added)), linkage(rows, "ward")[:, 2], rtol=1e-3)
    assert sorted(gone) == sorted(set(gone))
    assert set(range(150)) - set(gone) == {kept[-1]}


def test_pieces_are_cut_across_their_longest_axis() -> None:
    rows = np.random.default_rng(7).normal(size=(1200, 4)).astype(np.float32)
    far = np.random.default_rng(8).permutation(1200) < 600
    rows[far, 2] += 100.0
    pieces = codebooks._pieces(rows, 1000)
    assert sorted(map(tuple, pieces)) == sorted([tuple(np.flatnonzero(far)), tuple(np.flatnonzero(~far))])


def test_rows_of_a_lattice_have_many_equal_distances() -> None:
    lattice = np.stack(np.meshgrid(*[np.arange(12.0)] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    entries, labels = palette(lattice, np.ones(len(lattice)), 216)
    assert len(entries) <= 216
    assert palette_error(lattice, entries, labels, np.ones(len(lattice))) < 1.5 * len(lattice)


def test_a_row_takes_the_nearest_entry_of_the_pieces_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = some_rows(4000, 9)
    errors = {}
    for neighbours in (1, 32):
        monkeypatch.setattr(codebooks, "_NEIGHBOURS", neighbours)
        entries, labels = palette(rows, np.ones(4000), 500)
        errors[neighbours] = palette_error(rows, entries, labels, np.ones(4000))
    assert errors[32] < 0.99 * errors[1]


def test_equal_inputs_give_equal_bits() -> None:
    rows = some_rows(5000, 24)
    one, two = (palette(rows.copy(), np.ones(5000), 700) for _ in range(2))
    assert [part.tobytes() for part in one] == [part.tobytes() for part in two]


def test_no_rows_make_no_entries() -> None:
    entries, labels = palette(np.zeros((0, 9), np.float32), np.ones(0))
    assert (entries.shape, labels.shape) == ((0, 9), (0,))
