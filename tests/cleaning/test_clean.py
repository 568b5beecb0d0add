"""Cleaning removes floaters that were put in, keeps what photos need, and never asks test views."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import MakeRenderer

import clsplat.cleaning.clean as cleaning
from clsplat.cleaning.clean import clean, clean_without_views
from clsplat.compression.importance import measure_importance
from clsplat.device.device import Device
from clsplat.errors import InputError, OutputError
from clsplat.models.clean import clean_model
from clsplat.models.model import SceneChoice, load_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder


@pytest.fixture(scope="module")
def renderer(devices: list[Device], make_renderer: MakeRenderer) -> Renderer:
    return make_renderer(devices[0])


@pytest.fixture(scope="module")
def scene(model_folder: Path) -> Scene:
    return load_model(model_folder).load_scene()


@pytest.fixture(scope="module")
def sound(model_folder: Path, scene: Scene, renderer: Renderer) -> Splats:
    """Return the model without floaters of its own, so that the tolerance is left for those that are put in."""
    splats = load_model(model_folder).splats.with_near_plane(0.1)
    return clean(splats, scene.train, scene.extent, renderer, tolerance=0.2).splats


@pytest.fixture(scope="module")
def dirty(sound: Splats, scene: Scene) -> Splats:
    """Return the model with 12 unseen splats, one before a camera, and one that covers everything."""
    arrays = sound.to_numpy()
    more = {name: np.concatenate([values, values[:14]]) for name, values in arrays.items()}
    more["mean"][-14:-2] = 1e4
    camera = scene.train[0].camera
    depth = 1.05 * sound.near_plane
    more["mean"][-2] = camera.position + depth * camera.rotation[2]
    more["log_scale"][-2] = np.log(0.1 * depth)
    more["opacity_logit"][-2:] = [4.0, -5.0]
    more["log_scale"][-1] = np.log(2 * scene.extent)
    return sound.with_arrays(more)


def rows_of(splats: Splats) -> list[bytes]:
    """Return the parameters of each splat."""
    arrays = splats.to_numpy()
    return [b"".join(values[row].tobytes() for values in arrays.values()) for row in range(len(splats))]


def test_floaters_go_and_the_photos_lose_nothing(
    dirty: Splats, sound: Splats, scene: Scene, renderer: Renderer
) -> None:
    cleaned = clean(dirty, scene.train, scene.extent, renderer, tolerance=0.02)
    assert cleaned.before is not None
    assert cleaned.after is not None
    assert cleaned.after.psnr >= cleaned.before.psnr - 0.02
    assert set(cleaned.before.per_view) == {view.name for view in scene.train}
    removed = {rule.rule: rule.removed for rule in cleaned.rules}
    assert removed["unseen"] >= 12
    assert removed["near cameras"] >= 1
    assert removed["oversized"] + removed["near cameras"] >= 2
    assert "outside" not in removed, "these photos have no transparency"
    assert len(cleaned.splats) == len(dirty) - sum(removed.values())
    before = iter(rows_of(sound))
    assert all(row in before for row in rows_of(cleaned.splats)), "the rest has its bits and its order"


def test_the_tolerance_stops_a_rule(
    sound: Splats, scene: Scene, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rule that names every splat removes few of them, and those that change the images least."""
    every = lambda splats, extent: {"oversized": np.ones(len(splats), np.bool_)}  # noqa: E731
    monkeypatch.setattr(cleaning, "candidates_without_views", every)
    counts = []
    for tolerance in (0.0, 0.1, 1.0):
        cleaned = clean(sound, scene.train, scene.extent, renderer, tolerance=tolerance)
        assert cleaned.before is not None
        assert cleaned.after is not None
        assert cleaned.after.psnr >= cleaned.before.psnr - tolerance
        counts.append(len(cleaned.splats))
    assert counts[0] > counts[1] > counts[2] > 0


def test_a_dear_rule_leaves_the_tolerance_to_a_cheap_one(
    sound: Splats, scene: Scene, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first rule names nearly every splat, the second one splat that is worth little."""
    change = measure_importance(renderer, sound, scene.train, (0, 0, 0), parts=False).removal
    cheap = np.arange(len(sound)) == np.argsort(change)[len(sound) // 2]
    monkeypatch.setattr(cleaning, "candidates_of_views", lambda *_: {"near cameras": ~cheap})
    monkeypatch.setattr(cleaning, "candidates_without_views", lambda *_: {"oversized": cheap})
    cleaned = clean(sound, scene.train, scene.extent, renderer, tolerance=0.1)
    first, second = cleaned.rules
    assert (first.rule, first.removed) == ("oversized", 1)
    assert (second.rule, second.candidates) == ("near cameras", len(sound) - 1)
    assert 0 < second.removed < len(sound) - 1


def test_views_that_did_not_judge_take_a_rule_back(
    sound: Splats, scene: Scene, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = lambda splats, extent: {"oversized": np.arange(len(splats)) > 0}  # noqa: E731
    monkeypatch.setattr(cleaning, "candidates_without_views", every)
    monkeypatch.setattr(cleaning, "mean_psnr", lambda *_: 50.0)  # judges that like everything
    cleaned = clean(sound, scene.train, scene.extent, renderer)
    assert {rule.rule: rule.removed for rule in cleaned.rules}["oversized"] == 0
    assert len(cleaned.splats) > 1
    assert cleaned.after is not None
    assert cleaned.before is not None
    assert cleaned.after.psnr >= cleaned.before.psnr - 0.05


def test_without_views_only_what_no_photo_needs_goes(dirty: Splats) -> None:
    cleaned = clean_without_views(dirty)
    assert {rule.rule for rule in cleaned.rules} == {"faint", "oversized", "isolated"}
    assert cleaned.before is None
    assert len(cleaned.splats) == len(dirty) - sum(rule.removed for rule in cleaned.rules)
    arrays = dirty.to_numpy() | {"opacity_logit": np.full(len(dirty), -12.0)}
    with pytest.raises(InputError, match="no splat would be left"):
        clean_without_views(dirty.with_arrays(arrays))


def test_test_views_decide_nothing(model_folder: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    as_is = clean_model(model_folder)
    assert as_is.test_before is not None
    assert as_is.output is None
    black = [
        replace(view, image=np.zeros_like(view.image)) if view.name in scene.test_names else view
        for view in scene.views
    ]
    monkeypatch.setattr("clsplat.models.model.LoadedModel.load_scene", lambda *_, **__: replace(scene, views=black))
    other = clean_model(model_folder)
    assert other.test_before is not None
    assert other.test_before.psnr != as_is.test_before.psnr
    assert other.cleaned.rules == as_is.cleaned.rules
    np.testing.assert_array_equal(other.cleaned.splats.mean, as_is.cleaned.splats.mean)


def test_a_new_folder_is_a_model_and_the_old_one_is_kept(model_folder: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in model_folder.rglob("*") if path.is_file()}
    result = clean_model(model_folder, tmp_path / "new", use_photos=False)
    again = load_model(tmp_path / "new")
    assert len(again.splats) == len(result.cleaned.splats)
    assert again.iteration == load_model(model_folder).iteration
    assert not list((tmp_path / "new").glob(".*"))
    assert [view.name for view in again.load_scene().test] == [
        v.name for v in load_model(model_folder).load_scene().test
    ]
    assert {path: path.read_bytes() for path in model_folder.rglob("*") if path.is_file()} == before
    with pytest.raises(OutputError, match="is the model itself"):
        clean_model(model_folder, model_folder, overwrite=True)
    with pytest.raises(OutputError, match="already holds a model"):
        clean_model(model_folder, tmp_path / "new")
    with pytest.raises(OutputError, match=r"has no config\.json to copy"):
        clean_model(load_model(model_folder).ply, tmp_path / "other")
    with pytest.raises(OutputError, match="choose one of these endings"):
        clean_model(model_folder, tmp_path / "a.txt")


def test_exposures_stay_with_the_model(model_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(model_folder, tmp_path / "old")
    ModelFolder(tmp_path / "old").write_exposures({"a.png": [[1.0, 0.0, 0.0, 0.5]] * 3})
    clean_model(tmp_path / "old", tmp_path / "new", use_photos=False)
    old, new = (ModelFolder(tmp_path / name).exposures_path.read_bytes() for name in ("old", "new"))
    assert old == new


def test_a_file_is_judged_by_the_scene_that_is_named(model_folder: Path, capture_folder: Path, tmp_path: Path) -> None:
    model = load_model(model_folder)
    assert clean_model(model.ply, use_photos=None).cleaned.before is None
    found = clean_model(model.ply, tmp_path / "a.ply", scene=SceneChoice(capture_folder))
    assert found.cleaned.before is not None
    assert len(Splats.load(tmp_path / "a.ply")) == len(found.cleaned.splats)


@pytest.mark.parametrize(("option", "value"), [("tolerance", -1.0), ("tolerance", float("nan")), ("min_views", 0)])
def test_bad_options_are_refused(model_folder: Path, option: str, value: float) -> None:
    with pytest.raises(InputError, match=option):
        clean_model(model_folder, **{option: value})
