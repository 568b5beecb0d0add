"""Options of the runs of blocks: shares of the cap, and options that only the coarse run has."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsplat.blocks.options import of_coarse_run, shares_of_cap
from clsplat.training.config import TrainConfig


@pytest.mark.parametrize(
    ("cap", "counts", "shares"),
    [
        (120, [30, 10], [60, 60]),
        (100, [5, 5, 5], [33, 33, 33]),
        (120, [70, 1, 1, 1], [70, 16, 16, 16]),
        (120, [1, 60, 40, 1], [10, 60, 40, 10]),
        (6, [3, 2, 1], [3, 2, 1]),
        (9, [9], [9]),
        (9, [], []),
    ],
)
def test_shares_are_equal_but_for_blocks_that_begin_with_more(cap: int, counts: list[int], shares: list[int]) -> None:
    assert shares_of_cap(cap, counts) == shares


@given(st.lists(st.integers(1, 50), min_size=1, max_size=9), st.integers(0, 300))
def test_shares_fill_the_cap(counts: list[int], room: int) -> None:
    cap = sum(counts) + room
    shares = shares_of_cap(cap, counts)
    assert all(share >= count for share, count in zip(shares, counts, strict=True))
    assert cap - len(counts) < sum(shares) <= cap or max(shares) > min(shares) == cap // len(counts)
    assert sum(max(count, min(shares) + 1) for count in counts) > cap


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({}, []),
        ({"strategy": "adc", "opacity_reg": 0.0, "cap_max": 5}, []),
        ({"strategy": "mcmc", "visible_adam": True, "noise_lr": 5.0}, ["noise_lr", "strategy", "visible_adam"]),
    ],
)
def test_options_that_only_the_coarse_run_has(options: dict[str, object], names: list[str]) -> None:
    assert of_coarse_run(TrainConfig(**options)) == names
