"""What a model is made of: counts that a small model shows by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from model_strategies import random_arrays

from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.splats.stats import complexity


def test_counts_of_a_model_made_by_hand(tmp_path: Path) -> None:
    arrays = random_arrays("skew-normal", 10, 2, seed=1)
    arrays["skew"][3:], arrays["sh"][4:, 1:], arrays["sh"][1:, 4:] = 0, 0, 0
    found = complexity(Splats("skew-normal", arrays))
    assert (found.splats, found.skewed, found.skewed_fraction) == (10, 3, 0.3)
    assert found.bands == (6, 3, 1)
    assert found.coefficients == (30, 36, 15)
    assert found.parameters == 10 * 11 + 30 + 36 + 15 + 9
    assert found.stored == 10 * (11 + 3 + 27)
    Splats("skew-normal", arrays).save(tmp_path / "model.ply", compact=True)
    assert found.compact_bytes == len((tmp_path / "model.ply").read_bytes().split(b"end_header\n", 1)[1])


@pytest.mark.parametrize("shape", SHAPES)
def test_a_full_model_uses_all_it_stores(shape: str) -> None:
    splats = Splats(shape, random_arrays(shape, 7, 3, seed=2))
    found = complexity(splats)
    assert found.parameters == found.stored == sum(values.size for values in splats.arrays.values())


def test_a_model_without_splats() -> None:
    found = complexity(Splats("skew-normal", random_arrays("skew-normal", 0, 3, seed=3)))
    assert (found.splats, found.skewed_fraction, found.parameters, found.compact_bytes) == (0, 0.0, 0, 0)
    assert found.bands == (0, 0, 0, 0)
