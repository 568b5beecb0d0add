"""Validation views held out from the training views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.errors import InputError
from clsplat.scenes.scene import Scene
from clsplat.scenes.split import hold_out


def test_training_views_are_held_out_in_place_of_test_views(scene: Scene) -> None:
    split = hold_out(scene)
    assert scene.test_names.isdisjoint(split.names)
    assert {view.name for view in scene.train} == set(split.names)
    assert [view.name for view in split.test] == [scene.train[i].name for i in (1, 3, 5, 7)]
    assert len(split.train) == 4


@pytest.mark.parametrize(
    ("n", "places"), [(3, [1]), (4, [1, 3]), (9, [1, 4, 7]), (21, [3, 10, 17]), (43, [3, 10, 17, 24, 31, 38])]
)
def test_number_of_held_out_views(scene: Scene, n: int, places: list[int]) -> None:
    views = [replace(scene.views[0], name=f"{i:03}") for i in range(n)]
    split = hold_out(Scene("many", Path("many"), views, scene.points))
    assert [view.name for view in split.test] == [f"{i:03}" for i in places]
    assert split.train[0] is views[0]


def test_two_views_cannot_be_split(scene: Scene) -> None:
    with pytest.raises(InputError, match="has 2 training views; at least 3"):
        hold_out(replace(scene, views=scene.views[:2], test_names=frozenset()))
