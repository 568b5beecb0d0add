"""Cells: each place is in exactly one, and they have equal weights."""

from __future__ import annotations

import json

import numpy as np
import pytest

from clsplat.blocks.cells import Cells, make_cells, parse_blocks
from clsplat.errors import InputError


def scattered(n: int = 4000) -> np.ndarray:
    """Return places on a plane across z, ten times as wide along x as along y."""
    return np.random.default_rng(0).normal(size=(n, 3)) * (10, 1, 0.1)


@pytest.mark.parametrize(("columns", "rows"), [(2, 2), (3, 1), (1, 4), (4, 3)])
def test_cells_have_equal_weights(columns: int, rows: int) -> None:
    places = scattered()
    weights = np.random.default_rng(1).uniform(0.5, 1.5, len(places))
    cells = make_cells(places, weights, places[:9], columns, rows)
    assert cells.count == columns * rows
    of_cells = np.bincount(cells.of(places), weights, cells.count)
    assert of_cells == pytest.approx(np.full(cells.count, weights.sum() / cells.count), rel=0.01)
    assert np.abs(cells.axes) == pytest.approx(np.eye(3)[:2], abs=0.05), "the axes of the largest extent"
    assert cells.axes @ cells.axes.T == pytest.approx(np.eye(2))


def test_a_place_on_a_border_belongs_to_the_cell_behind_it() -> None:
    cells = Cells(np.eye(3)[:2], np.array([0.0, 1.0]), np.array([[0.0], [5.0], [-5.0]]))
    places = [(-1, -1, 9), (-1, 0, 9), (0, 4.9, 0), (0, 5, 0), (0.999, 9, 0), (1, -5, 0), (1e9, -6, 0)]
    assert cells.of(places).tolist() == [0, 1, 2, 3, 3, 5, 4]


def test_borders_are_far_or_near() -> None:
    cells = Cells(np.eye(3)[:2], np.array([1.0]), np.array([[0.0], [3.0]]))
    assert cells.distance_to_border([(0, 0.25, 7), (0, -9, 0), (1.5, 9, 0), (4, 3.5, 0)]).tolist() == [
        0.25,
        1,
        0.5,
        0.5,
    ]
    one_row = Cells(np.eye(3)[:2], np.array([1.0]), np.zeros((2, 0)))
    assert one_row.distance_to_border([(0, 5, 0)]).tolist() == [1.0]
    assert one_row.of([(0, 5, 0), (2, -5, 0)]).tolist() == [0, 1]


@pytest.mark.parametrize(("columns", "rows"), [(2, 3), (3, 1), (1, 2)])
def test_cells_come_back_from_a_file(columns: int, rows: int) -> None:
    places = scattered(300)
    cells = make_cells(places, np.ones(300), places[:9], columns, rows)
    found = Cells.from_json(json.loads(json.dumps(cells.to_json())))
    assert found.count == cells.count
    assert (found.of(places) == cells.of(places)).all()


def test_far_places_do_not_choose_the_axes() -> None:
    """A few splats of the sky, high above the ground."""
    places = np.concatenate([scattered(), [[0, 0, 1e6]] * 20])
    cells = make_cells(places, np.ones(len(places)), scattered(50), 2, 2)
    assert abs(cells.axes[0, 0]) > 0.9


def test_places_that_are_all_equal_are_in_one_cell() -> None:
    cells = make_cells(np.zeros((5, 3)), np.zeros(5), np.zeros((2, 3)), 2, 2)
    assert len(set(cells.of(np.zeros((5, 3))).tolist())) == 1


@pytest.mark.parametrize(("text", "blocks"), [("2x2", (2, 2)), ("1X8", (1, 8)), ("64x64", (64, 64))])
def test_numbers_of_blocks(text: str, blocks: tuple[int, int]) -> None:
    assert parse_blocks(text, 1000) == blocks


@pytest.mark.parametrize("text", ["", "2", "2x", "0x3", "1x1", "65x2", "2x2x2", "-1x2", "axb", "2 x 2"])
def test_other_texts_are_one_line(text: str) -> None:
    with pytest.raises(InputError, match=r"^blocks .*such as 2x2"):
        parse_blocks(text, 1000)


@pytest.mark.parametrize(
    ("cap", "blocks"), [(100, (2, 1)), (400_000, (2, 1)), (400_001, (2, 2)), (1_000_000, (3, 2)), (10**12, (64, 64))]
)
def test_auto_leaves_each_block_a_number_of_splats(cap: int, blocks: tuple[int, int]) -> None:
    assert parse_blocks("auto", cap) == blocks
