"""What blocks learn: their corrections sum to that of the photo."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.blocks.cells import make_cells
from clsplat.blocks.targets import BlockTargets, with_block_targets
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.scenes.view import StoredView
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.exposure_file import Exposures
from clsplat.training.run import train


@pytest.fixture(scope="module")
def model(scene: Scene) -> Splats:
    return train(scene, TrainConfig(iterations=40, cap_max=150, sh_degree=1)).splats


def halves(model: Splats, scene: Scene) -> list[tuple[Splats, Splats]]:
    """Return for each of two blocks its splats and the others."""
    cells = make_cells(model.mean, np.ones(len(model)), [v.camera.position for v in scene.train], 2, 1)
    inside = [np.flatnonzero(cells.of(model.mean) == number) for number in range(2)]
    return [(model.select(inside[i]), model.select(inside[1 - i])) for i in range(2)]


def learned_by(
    scene: Scene, inside: Splats, context: Splats, uncovered: float, exposures: Exposures | None = None
) -> Scene:
    """Return the scene that a block learns."""
    renderer = Renderer(keep=2)
    return with_block_targets(
        scene, lambda: BlockTargets(inside, context, renderer, scene.background, uncovered, exposures)
    )


def test_parts_of_all_blocks_sum_to_the_opacity(scene: Scene, model: Splats) -> None:
    renderer, view = Renderer(), scene.train[0]
    parts = [BlockTargets(*pair, renderer, scene.background, 0.5).part(view) for pair in halves(model, scene)]
    alpha = 1.0 - renderer.render(model, view.camera).alpha
    assert parts[0][0] + parts[1][0] == pytest.approx(1.0 - alpha, abs=1e-5)
    assert parts[0][1] == pytest.approx(parts[1][1], abs=1e-6)


def test_corrections_sum_to_that_of_the_photo(scene: Scene, model: Splats) -> None:
    renderer = Renderer()
    learned = [learned_by(scene, *pair, 0.5) for pair in halves(model, scene)]
    for number, view in enumerate(scene.views):
        shown = 255 * np.clip(renderer.render(model, view.camera, scene.background).color, 0, 1)
        corrections = sum(part.views[number].image.astype(float) - shown for part in learned)
        assert corrections == pytest.approx(view.image - shown, abs=1.01), "rounding of two images"
    assert [view.name for view in learned[0].views] == scene.names


def test_a_block_of_everything_learns_the_photos(scene: Scene, model: Splats) -> None:
    (only,) = [learned_by(scene, model, model.select([]), 1.0)]
    assert all((a.image == b.image).all() for a, b in zip(only.views, scene.views, strict=True))


def test_corrections_sum_to_that_of_a_photo_with_another_exposure(scene: Scene, model: Splats) -> None:
    renderer, exposure = Renderer(), np.array([[0.8, 0.1, 0.0, 0.05], [0.0, 0.9, 0.05, 0], [0.2, 0, 0.6, 0.02]])
    exposures = {view.name: exposure for view in scene.views[::2]}
    learned = [learned_by(scene, *pair, 0.5, exposures) for pair in halves(model, scene)]
    for number, view in enumerate(scene.views):
        color = renderer.render(model, view.camera, scene.background).color
        if view.name in exposures:
            color = np.einsum("ij,hwj->hwi", exposure[:, :3], color) + exposure[:, 3]
        shown = 255 * np.clip(color, 0, 1)
        corrections = sum(part.views[number].image.astype(float) - shown for part in learned)
        assert corrections == pytest.approx(view.image - shown, abs=1.01), "rounding of two images"


def test_a_picture_that_was_given_up_is_made_again(scene: Scene, model: Splats) -> None:
    """On a CPU a run gives up each picture once the device has it."""
    inside, context = halves(model, scene)[0]
    views = learned_by(scene, inside, context, 0.5).views
    before = [view.loaded().image.copy() for view in views[:2]]
    for view in views[:2]:
        assert isinstance(view, StoredView)
        assert view.is_kept
        view.release()
        assert not view.is_kept
    assert all((view.image == image).all() for view, image in zip(views[:2], before, strict=True))
    assert (before[0] != scene.views[0].image).any()
