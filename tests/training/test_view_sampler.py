"""View sampler: every view is drawn once before any is drawn again, at a size that suits the number of splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli_runner import HEIGHT, N_VIEWS, WIDTH

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.scenes.scene import View, load_scene
from clsplat.training.view_sampler import ViewSampler


@pytest.fixture(scope="module")
def views(capture_folder: Path) -> list[View]:
    return load_scene(capture_folder, eval=False).views


def test_permutations_and_their_rest_in_a_resumed_run(views: list[View]) -> None:
    whole, first = (ViewSampler(views, 1000, False, np.random.default_rng(1), []) for _ in range(2))
    drawn = [whole.next(iteration, 1)[0] for iteration in range(1, 2 * N_VIEWS + 1)]
    assert sorted(drawn[:N_VIEWS]) == sorted(drawn[N_VIEWS:]) == list(range(N_VIEWS))
    begun = [first.next(iteration, 1)[0] for iteration in range(1, 5)]
    rest = ViewSampler(views, 1000, False, first.rng, first.queue)
    assert begun + [rest.next(iteration, 1)[0] for iteration in range(5, 2 * N_VIEWS + 1)] == drawn


def test_size_goes_with_iteration_and_splats(views: list[View]) -> None:
    assert (WIDTH, HEIGHT) == (48, 36), "too small for coarse stages: made larger here"
    large = [
        View(view.name, Camera(480, 360, 400, 400, 240, 180, view.camera.cam_from_world), view.image) for view in views
    ]
    sampler = ViewSampler(large, 1000, True, np.random.default_rng(0), [])
    # 480 x 360 px: 8 pixels per splat, and then many more
    assert [sampler.next(iteration, 21_600)[1] for iteration in (1, 200, 201, 500, 501)] == [4, 4, 2, 2, 1]
    assert [sampler.next(iteration, 100)[1] for iteration in (1, 260, 261, 650, 651)] == [4, 4, 2, 2, 1]
    assert ViewSampler(large, 1000, False, np.random.default_rng(0), []).next(1, 1)[1] == 1


@pytest.mark.parametrize(("queue", "left_out"), [([3], []), ([-1], []), ([], [3]), ([], [0, 1, 2])])
def test_places_of_other_photos_are_refused(views: list[View], queue: list[int], left_out: list[int]) -> None:
    """They come from a checkpoint. Without a photo that may be trained, the search for one would not end."""
    with pytest.raises(InputError, match="is of a scene with other photos than these 3: start a new run"):
        ViewSampler(views[:3], 100, False, np.random.default_rng(0), queue, None, left_out)
