"""Decisions of a run: what the scene shows, what the caller named, and that commands and library decide alike."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clsplat.cameras.seen import mean_share_seen, seen
from clsplat.errors import InputError
from clsplat.models.model import load_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Points, Scene
from clsplat.splats.near_plane import NEAR_PLANE
from clsplat.splats.splats import Splats
from clsplat.training import decisions
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import (
    DROPOUT,
    FEW_FOR_LONG_RUN,
    FEW_POINTS,
    FEW_VIEWS,
    FEWEST_ITERATIONS,
    PENALTY,
    RANDOM_SHARE,
    RANDOM_SHARE_OF_FEW,
    RANDOM_SHARE_OF_VERY_FEW,
    RANDOM_START_RATES,
    SHORT_RUN,
    SMALL_DROPOUT,
    SMOOTHNESS,
    VERY_FEW_VIEWS,
    Decision,
    as_decided,
    decide,
)
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress
from clsplat.training.near_plane import FARTHEST, check_near_plane
from clsplat.training.presets import PRESETS, preset
from clsplat.training.run import train
from clsplat.training.silhouettes import transparent_share
from clsplat.training.trainer import Visit


def without_points(scene: Scene) -> Scene:
    points = scene.points
    return replace(scene, points=Points(points.xyz[:0], points.rgb[:0], points.track_length[:0]))


def options_of(**named: Any) -> TrainConfig:
    """Return options with a near plane and a filter, and without what few photos need; else a scene decides them."""
    usual = {"near_plane": 0.1, "antialiased": True, "low_pass": 0.1}
    return TrainConfig(**usual | {"dropout": 0.0, "depth_smoothness": 0.0, "occluder_check": False} | named)


def some_splats(scene: Scene, file: Path) -> Path:
    """A file of splats at the scene's points."""
    Splats.from_points(scene.points.xyz, scene.points.rgb).save(file)
    return file


def of_size(scene: Scene, factor: float) -> Scene:
    """Return the scene with all lengths times a factor."""
    views = []
    for view in scene.views:
        pose = view.camera.cam_from_world.copy()
        pose[:3, 3] *= factor
        views.append(replace(view, camera=view.camera.posed(pose)))
    points = scene.points
    return replace(scene, views=views, points=Points(factor * points.xyz, points.rgb, points.track_length))


def transparent(scene: Scene, share: float) -> Scene:
    """Return the scene with photos whose upper rows are transparent."""

    def alpha(height: int, width: int) -> np.ndarray:
        values = np.full((height, width), 255, np.uint8)
        values[: round(share * height)] = 0
        return values

    return replace(scene, views=[replace(view, alpha=alpha(*view.image.shape[:2])) for view in scene.views])


def test_good_points_and_opaque_photos_need_no_decision(scene: Scene) -> None:
    config = options_of(cap_max=len(scene.points), random_points=0.0)
    assert decide(scene, config) == Decision(config, ())
    assert decide(scene, options_of(init="model.ply")).reasons == (), "its filter is named"
    assert decide(transparent(scene, 0.5), config).config == config.replace(random_background=True)


def test_some_points_are_random_beside_good_ones(scene: Scene) -> None:
    """A twentieth of the cap, a tenth if the scene has fewer points, half of it if it has very few.

    A penalty on opacity removes needless ones.
    """
    n_points = len(scene.points)
    for cap, share in (
        (n_points, RANDOM_SHARE),
        (int(n_points / RANDOM_SHARE_OF_FEW) + 9, 0.1),
        (int(n_points / FEW_POINTS) - 9, 0.1),
    ):
        config = options_of(cap_max=cap)
        decision = decide(scene, config)
        assert decision.config == config.replace(random_points=share, opacity_reg=PENALTY)
        assert f"random points beside the scene's ({share:.0%} of the cap)" in str(decision)
    config = options_of(cap_max=len(scene.points))
    assert decide(scene, config.replace(opacity_reg=0.0)).config.density.opacity_reg == 0
    named = config.replace(random_points=0.02)
    assert decide(scene, named).config == named.replace(opacity_reg=PENALTY)
    assert decide(scene, options_of(init="model.ply", random_points=0.1)).reasons == ()
    by_relocation = config.replace(strategy="mcmc")
    assert decide(scene, by_relocation).config == by_relocation.replace(random_points=RANDOM_SHARE)


def with_views(scene: Scene, count: int) -> Scene:
    """Return the scene with that many training views, some of them under two names."""
    views = [
        replace(view, name=f"{round}-{view.name}")
        for round in range(-(-count // len(scene.train)))
        for view in scene.train
    ]
    return replace(scene, views=views[:count], test_names=frozenset())


@pytest.mark.parametrize(
    ("count", "dropout", "share"),
    [
        (3, DROPOUT, 0.0),
        (VERY_FEW_VIEWS, DROPOUT, 0.0),
        (VERY_FEW_VIEWS + 1, DROPOUT, RANDOM_SHARE),
        (FEW_VIEWS, DROPOUT, RANDOM_SHARE),
        (FEW_VIEWS + 1, SMALL_DROPOUT, RANDOM_SHARE),
        (FEW_FOR_LONG_RUN, SMALL_DROPOUT, RANDOM_SHARE),
        (FEW_FOR_LONG_RUN + 1, 0.0, RANDOM_SHARE),
    ],
)
def test_few_photos_get_dropout_smooth_depths_and_checks_and_very_few_no_random_points(
    scene: Scene, count: int, dropout: float, share: float
) -> None:
    few = with_views(scene, count)
    config = TrainConfig(near_plane=0.1, cap_max=len(scene.points))
    decision = decide(few, config)
    config = config.replace(antialiased=True, low_pass=0.1)
    assert decision.config == config.replace(
        dropout=dropout,
        depth_smoothness=SMOOTHNESS if count <= FEW_VIEWS else 0.0,
        occluder_check=count <= FEW_VIEWS,
        random_points=share or None,
        opacity_reg=PENALTY if share else 0.0,
    )
    reason = f"a dropout of {dropout:.0%} of the splats, because there are only {count} photos"
    assert (reason in str(decision)) == (dropout > 0)
    assert decide(few, config.replace(dropout=0.2)).config.views.dropout == 0.2
    assert decide(few, config.replace(depth_smoothness=0.5)).config.views.depth_smoothness == 0.5


@pytest.mark.parametrize(
    ("count", "short", "long"),
    [(FEW_VIEWS, DROPOUT, DROPOUT), (FEW_VIEWS + 1, 0.0, SMALL_DROPOUT), (FEW_FOR_LONG_RUN, 0.0, SMALL_DROPOUT)],
)
def test_long_runs_have_dropout_with_more_photos(scene: Scene, count: int, short: float, long: float) -> None:
    """The photos of all iterations decide how long a run is."""
    few = with_views(scene, count)

    def dropout(iterations: int, batch: int = 1) -> float:
        return decide(few, TrainConfig(iterations=iterations, batch=batch)).config.views.dropout

    assert dropout(SHORT_RUN) == short
    assert dropout(SHORT_RUN + 1) == long
    assert dropout(SHORT_RUN // 2 + 1, batch=2) == long


def test_test_and_validation_views_do_not_count(scene: Scene) -> None:
    many = with_views(scene, FEW_FOR_LONG_RUN + 2)
    held_out = replace(many, test_names=frozenset({many.names[0]}), validation_names=frozenset({many.names[1]}))
    assert decide(many, TrainConfig()).config.views.dropout == 0
    assert decide(held_out, TrainConfig()).config.views.dropout == SMALL_DROPOUT


@pytest.mark.parametrize("options", [{"init": "random"}, {"cap_max": 1_000_000}, {}])
def test_random_starts_and_few_points(scene: Scene, options: dict[str, Any]) -> None:
    """Transparent photos get the strategy that relocates, other photos a penalty on opacity."""
    start = scene if options else without_points(scene)
    beside = {"random_points": RANDOM_SHARE_OF_VERY_FEW} if "cap_max" in options else {}
    config = options_of(opacity_lr=0.07, **options)
    assert decide(start, config).config == config.replace(opacity_reg=PENALTY, **beside)
    seen = transparent(start, 0.5)
    expected = options_of(opacity_lr=0.07, strategy="mcmc", random_background=True, **options, **beside)
    assert decide(seen, config).config == expected
    by_gradient = options_of(strategy="adc", **options)
    assert decide(seen, by_gradient).config == by_gradient.replace(
        random_background=True, opacity_reg=PENALTY, lr_factor=RANDOM_START_RATES, **beside
    )


def test_transparent_photos_get_random_backgrounds(scene: Scene) -> None:
    seen = transparent(scene, 0.5)
    assert transparent_share(seen.train) == pytest.approx(0.5, abs=0.1)
    decision = decide(seen, TrainConfig())
    assert decision.config.random_background
    assert "random backgrounds for 80% of the run, because" in str(decision)
    assert "% of the photos' pixels are transparent" in str(decision)
    assert "random backgrounds, because" in str(decide(seen, TrainConfig(random_background_until=1.0)))
    assert not decide(seen, TrainConfig(random_background=False)).config.random_background
    assert not decide(transparent(scene, 0.0), TrainConfig()).config.random_background, "an alpha of 255 is opaque"


def test_only_visible_splats_step_on_a_gpu_that_sees_a_part(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos show half of the points of this scene: the others are behind all cameras."""
    points = scene.points
    devices = {kind: SimpleNamespace(info=SimpleNamespace(type=kind)) for kind in ("CPU", "GPU")}
    behind = points.xyz + 1e4
    doubled = [
        np.concatenate([a, b]) for a, b in ((points.xyz, behind), *[(a, a) for a in (points.rgb, points.track_length)])
    ]
    part = replace(scene, points=Points(*doubled))
    assert mean_share_seen([view.camera for view in part.train], part.points.xyz) < 0.5
    config = options_of(cap_max=200_000)
    monkeypatch.setattr("clsplat.training.decisions.open_device", lambda name: devices["CPU"])
    assert not decide(part, config).config.optim.visible_adam
    monkeypatch.setattr("clsplat.training.decisions.open_device", lambda name: devices["GPU"])
    decision = decide(part, config)
    assert decision.config.optim.visible_adam
    assert re.search(r"steps of visible splats only, because a photo shows [34]\d% of the points", str(decision))
    assert not decide(part, config.replace(visible_adam=False)).config.optim.visible_adam
    assert not decide(part, config.replace(depth_smoothness=0.5)).config.optim.visible_adam, "hidden splats move, too"
    assert not decide(part, config.replace(cap_max=60_000)).config.optim.visible_adam, "too few splats"
    assert not decide(without_points(scene), config).config.optim.visible_adam
    assert decide(part, decision.config).config == decision.config
    assert all(not preset(name)["visible_adam"] for name in PRESETS)


def test_named_options_stay(scene: Scene) -> None:
    """Options of a strategy that is not the default are kept until the strategy is known."""
    start = transparent(without_points(scene), 0.5)
    assert decide(start, options_of(growth=1.2, init_scale=0.3)).config == options_of(
        growth=1.2, init_scale=0.3, strategy="mcmc", random_background=True, lr_factor=2.0
    )
    named = options_of(strategy="adc", random_background=False, opacity_reg=0.0, lr_factor=1.0)
    assert decide(start, named).config == named
    assert decide(start, named).reasons == ()
    assert decide(start, options_of(cap_max=7).replace(strategy="adc")).config.strategy == "adc"
    complete = decide(start, options_of()).config
    again = decide(scene, complete)
    assert again.config == complete, "nothing is decided twice"
    assert again.reasons == ()


def test_complete_options_decode_no_photo(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    start = transparent(without_points(scene), 0.5)
    complete = decide(start, options_of()).config
    asked: list[str] = []
    monkeypatch.setattr(decisions, "transparent_share", lambda views: asked.append("photos") or 0.5)
    assert decide(start, complete.replace(iterations=40, random_points=0.1)).config.random_background
    assert not asked
    for name in ("random_points", "random_background", "strategy"):
        others = {key: value for key, value in complete.named_options.items() if key != name}
        decide(start, options_of(**others))
        assert asked.pop() == "photos", name


def test_the_near_plane_is_that_of_3dgs_unless_the_scene_is_small_or_near(scene: Scene) -> None:
    """0.2 units, a twentieth of the extent, or half of the depth up to which a hundredth of the points lie."""
    depths = [seen(view.camera, scene.points.xyz) for view in scene.train]
    nearest = np.quantile(np.concatenate([found.depth[found.inside] for found in depths]), 0.01)
    assert FARTHEST == 0.2
    for size in (100.0, 1.0, 0.01, 1e-6):
        sized = of_size(scene, size)
        decision = decide(sized, TrainConfig())
        near = min(0.2, 0.05 * sized.extent, 0.5 * size * nearest)
        assert decision.config.near_plane == pytest.approx(near, rel=0.05)
        assert (f"a near plane of {decision.config.near_plane:g} units" in str(decision)) == (near < 0.2)
        check_near_plane(sized, decision.config.near_plane)
    away = replace(scene, points=Points(scene.points.xyz + 1e6, scene.points.rgb, scene.points.track_length))
    assert decide(away, TrainConfig()).config.near_plane == pytest.approx(min(0.2, 0.05 * scene.extent), rel=0.05)
    middle, points = scene.train[0].camera, scene.points
    place = middle.position + 0.1 * middle.rotation[2]
    close = replace(scene, points=Points(np.tile(place, (len(points.xyz), 1)), points.rgb, points.track_length))
    assert decide(close, TrainConfig()).config.near_plane == pytest.approx(min(0.05, 0.05 * scene.extent), rel=0.05)
    assert "points are close to a camera" in str(decide(of_size(close, 3.0), TrainConfig()))
    assert "because the cameras stand close together" in str(decide(of_size(away, 0.1), TrainConfig()))
    assert decide(scene, TrainConfig(near_plane=0.7)).config.near_plane == 0.7
    unnamed = dataclasses.replace(TrainConfig(), seed=3)  # it passes all options of the run to the constructor
    assert decide(scene, unnamed).config.near_plane == decide(scene, TrainConfig()).config.near_plane


@pytest.mark.parametrize("named", [{"scaling_lr": 0.01}, {"position_lr_final": 1e-6}, {"lr_factor": 1.0}], ids=str)
def test_random_starts_have_higher_rates_unless_a_rate_is_named(scene: Scene, named: dict[str, float]) -> None:
    start = without_points(scene)
    assert decide(start, TrainConfig()).config.optim.lr_factor == RANDOM_START_RATES
    assert decide(scene, TrainConfig(init="random")).config.optim.lr_factor == RANDOM_START_RATES
    assert decide(scene, TrainConfig(cap_max=len(scene.points))).config.optim.lr_factor == 1
    assert decide(start, TrainConfig(iterations=FEWEST_ITERATIONS - 1)).config.optim.lr_factor == 1
    assert decide(start, TrainConfig(**named)).config.optim == TrainConfig(**named).optim


@pytest.mark.parametrize(
    ("options", "shape"),
    [
        ({"iterations": SHORT_RUN}, "gaussian"),
        ({"iterations": SHORT_RUN + 1}, "skew-normal"),
        ({"iterations": 100, "init": "random"}, "gaussian"),
        ({"iterations": SHORT_RUN // 2, "batch": 2}, "gaussian"),
        ({"iterations": SHORT_RUN // 2 + 1, "batch": 2}, "skew-normal"),
        ({"iterations": SHORT_RUN // 2 + 1, "device": "cpu/2"}, "skew-normal"),
        ({"iterations": 100, "init": "model.ply", "antialiased": True, "low_pass": 0.1}, "skew-normal"),
        ({"iterations": 100, "shape": "skew-normal"}, "skew-normal"),
        ({"iterations": 100, "shape": "student-t"}, "student-t"),
        ({"iterations": 100, "skew_lr": 1e-3}, "skew-normal"),
        ({"iterations": 100, "skew_map": "cube-root"}, "skew-normal"),
        ({"iterations": 100, "alternation": "cyclic"}, "skew-normal"),
        ({"iterations": 100, "normalisation": "pdf"}, "skew-normal"),
    ],
    ids=str,
)
def test_short_runs_have_gaussians_unless_a_skew_is_named(scene: Scene, options: dict[str, Any], shape: str) -> None:
    decision = decide(scene, TrainConfig(**options))
    assert decision.config.shape == shape
    assert ("shape gaussian, because" in str(decision)) == (shape == "gaussian")
    assert decide(scene, decision.config).config == decision.config


def test_a_longer_run_keeps_the_shape_of_the_short_one(scene: Scene, tmp_path: Path) -> None:
    short = TrainConfig(iterations=4, cap_max=40, sh_degree=0)
    train(scene, short, output=tmp_path)
    longer = train(scene, short.replace(iterations=SHORT_RUN + 1), output=tmp_path, resume=True, visit=stop_at(5))
    assert longer.splats.shape == "gaussian"
    assert longer.iteration == 5


def stop_at(iteration: int) -> Visit:
    """Return a visit that ends the run after an iteration."""
    return lambda trainer, stop: stop.set() if trainer.iteration == iteration else None


@pytest.mark.parametrize("name", PRESETS)
def test_presets_decide_the_near_plane_and_the_low_pass_only(scene: Scene, name: str) -> None:
    decided = decide(scene, TrainConfig(**preset(name))).config
    assert decided.near_plane is not None
    assert (decided.antialiased, decided.low_pass) == (False, 0.3)
    config = options_of(**preset(name) | {"low_pass": 0.3})
    decision = decide(transparent(without_points(scene), 0.5), config)
    assert decision.config == config
    assert decision.reasons == ()


def test_a_run_stores_what_it_decided_and_says_it_once(scene: Scene, tmp_path: Path) -> None:
    """A resumed run keeps the decisions, also if it is longer."""
    start, messages = without_points(scene), []

    def hear(progress: Progress) -> None:
        messages.append(progress.message)

    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    train(start, config, hear, output=tmp_path)
    stored = ModelFolder(tmp_path).read_config()["config"]
    assert (stored["strategy"], stored["random_background"], stored["opacity_reg"]) == ("adc", False, PENALTY)
    assert sum(message.startswith("decided:") for message in messages) == 1
    messages.clear()
    # The points would decide otherwise.
    train(scene, config.replace(iterations=4), hear, output=tmp_path, resume=True)
    assert ModelFolder(tmp_path).read_config()["config"] == stored | {"iterations": 4}
    assert not any(message.startswith("decided:") for message in messages)


def test_a_model_has_the_near_plane_of_its_run(scene: Scene, tmp_path: Path) -> None:
    """Training does not see what is nearer, and the images of the model do not show it."""
    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    train(scene, config, output=tmp_path / "decided")
    assert load_model(tmp_path / "decided").splats.near_plane == decide(scene, config).config.near_plane
    depths = [seen(view.camera, scene.points.xyz) for view in scene.train]
    near = 1.001 * float(np.quantile(np.concatenate([found.depth[found.inside] for found in depths]), 0.05))
    splats = train(scene, config.replace(near_plane=near, init=str(some_splats(scene, tmp_path / "s.ply")))).splats
    assert splats.near_plane == near
    camera, renderer = scene.train[0].camera, Renderer()
    flat = splats.as_shape("gaussian")
    shown = flat.mean @ camera.rotation[2] + camera.translation[2] >= near
    assert 0 < shown.sum() < len(flat)
    image, kept = renderer.render(flat, camera).color, flat.select(shown).with_near_plane(NEAR_PLANE)
    np.testing.assert_array_equal(image, renderer.render(kept, camera).color)
    with pytest.raises(InputError, match="nearer than the near plane"):
        train(scene, config.replace(near_plane=2 * near), output=tmp_path / "refused")


def test_a_run_of_an_earlier_version_keeps_its_near_plane(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    train(scene, config, output=tmp_path)
    checkpoint = Checkpoint.load(ModelFolder(tmp_path).checkpoint_path)
    del checkpoint.config["near_plane"]
    checkpoint.save(ModelFolder(tmp_path).checkpoint_path)
    train(scene, config.replace(iterations=3), output=tmp_path, resume=True)
    assert load_model(tmp_path).splats.near_plane == NEAR_PLANE


def test_models_are_antialiased_with_a_low_pass_as_wide_as_a_pixel(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    filters = {
        (True, 0.1): {},
        (False, 0.3): {"antialiased": False},
        (True, 0.2): {"low_pass": 0.2},
        (False, 0.2): {"antialiased": False, "low_pass": 0.2},
    }
    for expected, named in filters.items():
        decided = decide(scene, config.replace(**named)).config
        assert (decided.antialiased, decided.low_pass) == expected
        splats = train(scene, config.replace(**named)).splats
        assert (splats.antialiased, splats.low_pass) == expected


def test_a_run_that_starts_from_a_model_keeps_its_filter(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    points = Splats.from_points(scene.points.xyz, scene.points.rgb)
    for antialiased, low_pass in ((True, 0.1), (True, 0.3), (False, 0.3)):
        file = tmp_path / f"{antialiased}{low_pass}.ply"
        Splats(points.shape, points.arrays, antialiased=antialiased, low_pass=low_pass).save(file)
        decision = decide(scene, config.replace(init=str(file)))
        assert ("no antialiasing, because the model" in str(decision)) == (not antialiased)
        splats = train(scene, config.replace(init=str(file))).splats
        assert (splats.antialiased, splats.low_pass) == (antialiased, low_pass)


def test_what_a_model_lacks_is_said_once(scene: Scene, tmp_path: Path) -> None:
    """Its filter is looked at before its splats are read for the run."""
    file = some_splats(scene, tmp_path / "s.ply")
    content = bytearray(file.read_bytes())
    first = content.index(b"end_header\n") + len(b"end_header\n")
    content[first : first + 4] = np.float32(np.nan).tobytes()
    file.write_bytes(content)
    with pytest.warns(UserWarning, match="left out 1 of") as said:
        train(scene, TrainConfig(iterations=2, cap_max=40, sh_degree=0, init=str(file)))
    assert len(said) == 1


def test_a_run_of_an_earlier_version_keeps_its_filter(scene: Scene, tmp_path: Path) -> None:
    """Earlier versions had a low pass of 0.3 in all runs, and stored none."""
    for antialiased in (False, True):
        folder = tmp_path / str(antialiased)
        train(scene, TrainConfig(iterations=2, cap_max=40, sh_degree=0, antialiased=antialiased), output=folder)
        checkpoint = Checkpoint.load(ModelFolder(folder).checkpoint_path)
        del checkpoint.config["low_pass"]
        checkpoint.save(ModelFolder(folder).checkpoint_path)
        longer = TrainConfig(iterations=3, cap_max=40, sh_degree=0)
        train(scene, longer, output=folder, resume=True)
        splats = load_model(folder).splats
        assert (splats.antialiased, splats.low_pass) == (antialiased, 0.3)


def test_decisions_of_a_stored_run_replace_undecided_options() -> None:
    stored = TrainConfig(strategy="mcmc", random_background=True).to_json()
    penalty = stored["opacity_reg"]
    assert as_decided(TrainConfig(), stored) == TrainConfig(strategy="mcmc", random_background=True)
    assert as_decided(TrainConfig(strategy="adc"), stored) == TrainConfig(
        strategy="adc", random_background=True, opacity_reg=penalty
    )
