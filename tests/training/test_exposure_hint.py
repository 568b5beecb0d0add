"""Photos whose exposures differ much get a hint; others do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.cameras.seen import seen
from clsplat.scenes.colmap import Points
from clsplat.scenes.demo.scene import write_capture
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.exposure_hint import (
    LARGE_SPREAD,
    exposure_hint,
    exposure_spread,
    unexplained_share,
    usual_exposures,
)
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.stages import StepReports

CONFIG = TrainConfig(iterations=3, cap_max=50, sh_degree=0)


@pytest.fixture(scope="module")
def long_scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small capture with 21 training photos."""
    return load_scene(write_capture(tmp_path_factory.mktemp("long") / "yard", 48, 36, 24))


def exposed(scene: Scene, stops: float) -> Scene:
    """Return the scene with photos of alternating exposure, `stops` above and below."""
    views = []
    for number, view in enumerate(scene.views):
        light = (np.asarray(view.image) / 255.0) ** 2.2 * 2.0 ** (stops * (-1) ** number)
        image = np.rint(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)
        views.append(View(view.name, view.camera, image))
    return replace(scene, views=views)


def test_photos_of_one_exposure(scene: Scene) -> None:
    spread = exposure_spread(scene.train, scene.points)
    assert spread is not None
    assert spread < 0.2
    assert exposure_hint(scene, CONFIG) is None


@pytest.mark.parametrize("stops", [0.3, 1.0, 1.5])
def test_the_spread_is_in_stops(scene: Scene, stops: float) -> None:
    """Bright pixels that are clipped do not count, so that dark photos say more."""
    spread = exposure_spread(exposed(scene, stops).train, scene.points)
    assert spread == pytest.approx(stops, rel=0.25, abs=0.05)


def test_a_cast_of_colour_is_an_exposure(scene: Scene) -> None:
    """Half of the photos have less blue, so that their brightness hardly differs."""
    views = []
    for number, view in enumerate(scene.views):
        image = np.asarray(view.image).astype(np.float64)
        image[..., 2] *= 0.6 ** (number % 2)
        views.append(View(view.name, view.camera, np.rint(image).astype(np.uint8)))
    spread = exposure_spread(replace(scene, views=views).train, scene.points)
    assert spread == pytest.approx(2.2 * -np.log2(0.6) / 2, rel=0.2)


def test_a_run_says_it_once_and_not_with_the_option(scene: Scene) -> None:
    messages: list[str] = []
    uneven = exposed(scene, 1.5)

    def hear(progress: Progress) -> None:
        messages.append(progress.message)

    train(uneven, CONFIG, hear)
    said = [message for message in messages if "the photos differ in exposure (by 1." in message]
    assert len(said) == 1
    assert said[0].endswith("stops from their mean): the option exposure learns them")
    assert exposure_hint(uneven, CONFIG.replace(exposure=True)) is None


def test_two_exposures_of_one_stop_get_a_hint(long_scene: Scene) -> None:
    """Their spread alone is not more than that of photos of one exposure, but exposures explain it."""
    uneven = exposed(long_scene, 0.5)
    spread = exposure_spread(uneven.train, uneven.points)
    assert spread is not None
    assert 0.35 < spread < LARGE_SPREAD
    assert unexplained_share(uneven.train, uneven.points) < 0.8
    assert exposure_hint(uneven, CONFIG) is not None
    assert exposure_hint(exposed(long_scene, 0.2), CONFIG) is None


def test_a_spread_that_exposures_do_not_explain_gets_no_hint(
    long_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflections, and what hides points, differ between photos, too."""
    monkeypatch.setattr("clsplat.training.exposure_hint.exposure_spread", lambda *_: 0.5)
    assert exposure_hint(long_scene, CONFIG) is None
    monkeypatch.setattr("clsplat.training.exposure_hint.exposure_spread", lambda *_: 0.7)
    assert exposure_hint(long_scene, CONFIG) is not None


def darkened(scene: Scene, numbers: list[int], factors: tuple[float, float, float]) -> Scene:
    """Return the scene with a few training photos of other channels."""
    names = [scene.train[number].name for number in numbers]
    views = [
        replace(view, image=(np.asarray(view.image) * factors).astype(np.uint8)) if view.name in names else view
        for view in scene.views
    ]
    return replace(scene, views=views)


@pytest.mark.parametrize("factors", [(0.25, 0.25, 0.25), (1.0, 1.0, 0.4), (0.0, 0.0, 0.0)])
def test_a_few_dark_photos_are_not_usual(long_scene: Scene, factors: tuple[float, float, float]) -> None:
    dark = darkened(long_scene, [2, 7, 11], factors)
    assert np.flatnonzero(~usual_exposures(dark.train, dark.points)).tolist() == [2, 7, 11]
    assert usual_exposures(long_scene.train, long_scene.points).all()
    many = darkened(long_scene, [*range(0, 21, 3)], factors)
    assert usual_exposures(many.train, many.points).all(), "too many to be exceptions: all usual"
    none = Points(dark.points.xyz[:0], dark.points.rgb[:0], dark.points.track_length[:0])
    assert usual_exposures(dark.train, none).all(), "usual without points"


def test_a_few_bright_points_do_not_make_a_photo_unusual(long_scene: Scene) -> None:
    """30 points are in a photo that is white at 12 of them: too few are left to tell its exposure."""
    view, points = long_scene.train[3], long_scene.points
    coloured = np.flatnonzero(((points.rgb > 20) & (points.rgb < 230)).all(axis=1))
    found = seen(view.camera, points.xyz[coloured])
    pixels, first = np.unique(np.stack(found.rows_and_columns), axis=1, return_index=True)
    few = coloured[found.inside][first[:30]]
    assert len(few) == 30
    image = np.full_like(np.asarray(view.image), 100)
    image[tuple(pixels[:, :12])] = 255
    views = [replace(one, image=image) if one.name == view.name else one for one in long_scene.train]
    assert usual_exposures(views, Points(points.xyz[few], points.rgb[few], points.track_length[few])).all()


def test_few_photos_do_not_say_what_exposures_explain(long_scene: Scene) -> None:
    """With few photos, most points are in so few that exposures explain anything."""
    uneven = exposed(long_scene, 0.5)
    assert unexplained_share(uneven.train[:11], long_scene.points) == 1.0
    assert unexplained_share(uneven.train[:12], long_scene.points) < 1.0
    assert exposure_hint(replace(uneven, views=uneven.train[:11], test_names=frozenset()), CONFIG) is None


def test_points_that_the_photos_hardly_show_explain_nothing(long_scene: Scene) -> None:
    points = long_scene.points
    few = Points(points.xyz[:5], points.rgb[:5], points.track_length[:5])
    assert unexplained_share(exposed(long_scene, 1.5).train, few) == 1.0


def test_few_points_say_nothing(scene: Scene) -> None:
    few = Points(scene.points.xyz[:5], scene.points.rgb[:5], scene.points.track_length[:5])
    nothing = Points(scene.points.xyz[:0], scene.points.rgb[:0], scene.points.track_length[:0])
    assert exposure_spread(exposed(scene, 1.5).train, few) is None
    assert exposure_spread(exposed(scene, 1.5).train, nothing) is None
    assert exposure_spread(exposed(scene, 1.5).train[:3], scene.points) is None


def test_points_of_one_colour_say_nothing(scene: Scene) -> None:
    """Clouds without colours are grey."""
    grey = replace(scene.points, rgb=np.full_like(scene.points.rgb, 128))
    assert exposure_spread(scene.train, grey) is None
    assert exposure_spread(scene.train, scene.points) is not None


def test_a_training_in_steps_says_it_once() -> None:
    """Each run of its steps has the hint. Messages of other runs and numbers are sent as they are."""
    heard: list[Progress] = []
    steps = StepReports(heard.append, 2, 10)
    assert steps.progress is not None
    for step in (1, 2):
        steps.tell(step, "a run")
        for message in ("a hint", f"of run {step}", "", ""):
            steps.progress(Progress.note(message, 10))
    assert [(report.phase, report.message) for report in heard] == [
        ("", "step 1 of 2, a run"),
        ("step 1 of 2", "a hint"),
        ("step 1 of 2", "of run 1"),
        ("step 1 of 2", ""),
        ("step 1 of 2", ""),
        ("", "step 2 of 2, a run"),
        ("step 2 of 2", "of run 2"),
        ("step 2 of 2", ""),
        ("step 2 of 2", ""),
    ]
