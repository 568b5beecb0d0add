"""Words for values in messages."""

from __future__ import annotations

import math

import numpy as np
import pytest

from clsplat.files.json_file import describe_any


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (10.5, "10.5"),
        (-3, "-3"),
        (10**15, "1000000000000000"),
        (10**20, "1e+20"),
        (10**400, "a number of hundreds of digits"),
        (math.nan, "nan"),
        (np.float32(0.5), "0.5"),
        (np.int64(7), "7"),
        (True, "true"),
        (None, "null"),
        ("a", "the text 'a'"),
        ([1, 2], "a list"),
        ({}, "an object"),
        ((1, 2), "a tuple"),
        (np.ones(2), "a ndarray"),
    ],
)
def test_a_value_of_any_type_has_few_words(value: object, words: str) -> None:
    assert describe_any(value) == words
