"""Alternating optimisation: the warm-up, the cycle, and runs without alternation."""

from __future__ import annotations

from dataclasses import replace

import pytest

from clsplat.training.config import TrainConfig
from clsplat.training.methods.sns import learning_groups

CONFIG = TrainConfig(
    iterations=100, alternation="cyclic", alternation_warmup=0.2, alternation_cycle=10, alternation_split=0.3
)


def pattern(config: TrainConfig) -> str:
    """Return one letter for each iteration: B base, S skew, J both."""
    letters = {(True, True): "J", (True, False): "B", (False, True): "S"}
    return "".join(letters[learning_groups(it, config)] for it in range(1, config.iterations + 1))


def test_joint_warm_up_then_cycles_that_begin_with_the_base() -> None:
    assert pattern(CONFIG) == "J" * 20 + ("BBB" + "S" * 7) * 8


@pytest.mark.parametrize(("split", "expected"), [(0.0, "S"), (1.0, "B")])
def test_a_split_at_its_ends_freezes_one_group_for_good(split: float, expected: str) -> None:
    assert pattern(replace(CONFIG, alternation_split=split)) == "J" * 20 + expected * 80


def test_a_last_cycle_is_cut_and_no_warm_up_begins_at_once() -> None:
    config = replace(CONFIG, iterations=14, alternation_warmup=0.0)
    assert pattern(config) == "BBBSSSSSSSBBBS"


def test_off_and_shapes_without_skew_train_jointly() -> None:
    for config in (replace(CONFIG, alternation="off"), replace(CONFIG, shape="gaussian")):
        assert pattern(config) == "J" * 100
