"""Cameras: wrong values are refused in one line that names them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError

GOOD: dict[str, Any] = {
    "width": 3,
    "height": 2,
    "fx": 1.0,
    "fy": 1.0,
    "cx": 1.0,
    "cy": 1.0,
    "cam_from_world": np.eye(4),
}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("width", "a", "width is the text 'a'; expected a whole number of pixels"),
        ("width", 2.7, "width is 2.7; expected"),
        ("height", float("nan"), "height is nan; expected"),
        ("height", float("inf"), "height is inf; expected"),
        ("width", None, "width is null; expected"),
        ("width", 0, "0x2; both must be at least 1"),
        ("fx", "q", "fx is the text 'q'; expected a number of pixels"),
        ("fy", np.ones(2), "fy is a ndarray; expected"),
        ("cx", None, "cx is null; expected"),
        ("cam_from_world", "x", r"must be a finite \(4, 4\)"),
        ("cam_from_world", [[1, 2], [3]], r"must be a finite \(4, 4\)"),
        ("cam_from_world", np.eye(4) + np.diag([0, 0, 0, 4.0]), "last row is"),
    ],
)
def test_a_wrong_value_is_named(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Camera(**GOOD | {name: value})
    assert "\n" not in str(caught.value)


def test_numbers_of_any_kind_are_sizes() -> None:
    camera = Camera(**GOOD | {"width": np.int64(5), "height": 4.0, "fx": np.float32(2.0), "cx": 2})
    assert (camera.width, camera.height, camera.fx, camera.cx) == (5, 4, 2.0, 2.0)
    assert isinstance(camera.width, int)
