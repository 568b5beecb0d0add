"""Exposure, masks and transparency in training: kernels agree with float64 formulas, and exposures are learned."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import clsplat
from numpy.typing import NDArray
from reference.loss import reference_loss, reference_loss_gradient
from reference.tolerances import ROUNDING, relative_error

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.device.memory import Pool, to_host
from clsplat.device.program import Real
from clsplat.device.schedule import Schedule, default_schedule
from clsplat.errors import InputError
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.exposure import PhotoLoss
from clsplat.training.exposure_file import exposures_json, read_exposures
from clsplat.training.folder import ModelFolder
from clsplat.training.loss import ImageLoss
from clsplat.training.run import train
from clsplat.training.targets import Targets, target_channels
from clsplat.training.trainer import Trainer

SIZES = [(3, 2), (40, 5), (13, 14), (150, 3)]  # width, height: less than a vector, and several work-items a row
# Background colours of the photos and of the render.
BEHIND, NEW = (0.2137, 0.4071, 0.6113), (0.9059, 0.1011, 0.5023)


def laid_over(image: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Replace the background of a photo by that of the render, 0..255."""
    through = 1 - alpha[:, :, None] / 255
    return np.clip(image + 255 * through * (np.array(NEW) - np.array(BEHIND)), 0, 255)


def opacity(view: View) -> NDArray[np.uint8]:
    return np.full(view.image.shape[:2], 255, np.uint8) if view.alpha is None else view.alpha


def transparency(view: View) -> NDArray[np.float64]:
    """Return the part of the background in each pixel, (H, W, 1)."""
    return 1 - opacity(view)[:, :, None] / 255


def views_of(masks: bool, alphas: bool) -> list[View]:
    rng = np.random.default_rng(3)
    views = []
    for i, (width, height) in enumerate(SIZES):
        image = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
        mask = rng.random((height, width)) < 0.7 if masks and i != 1 else None
        alpha = rng.integers(0, 256, (height, width)).astype(np.uint8) if alphas and i != 2 else None
        if alpha is not None:  # no colour may lie halfway between two bytes
            halfway = np.abs(laid_over(image, alpha) % 1 - 0.5) < 1e-3
            alpha[halfway.any(axis=2)] = 255
            alpha[:, 0] = 0
        views.append(
            View(f"{i}.png", Camera(width, height, 25.0, 26.0, width / 2, height / 2, np.eye(4)), image, mask, alpha)
        )
    return views


def photo_loss(
    device: Device, schedule: Schedule, real: Real, views: list[View], exposure: bool, usual: list[bool] | None = None
) -> PhotoLoss:
    if real == "double" and not device.has_fp64:
        pytest.skip("no double precision")
    kernels = KernelBuild("gaussian", 0, schedule, real=real)
    config = TrainConfig(exposure=exposure, random_background=True, iterations=100)
    targets = Targets(device, kernels, views, 10**9, target_channels(views, config))
    return PhotoLoss(
        ImageLoss(Pool(device), kernels, 0.2), targets, config, BEHIND, None if usual is None else np.array(usual)
    )


def wanted_of(
    color: NDArray[np.float64], exposure: NDArray[np.float64], view: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the render with the photo's exposure, and the photo over the render's background; both (H, W, 3).

    The exposure does not change the background.
    """
    through = transparency(view)
    shown = (color - through * NEW) @ exposure[:, :3].T + (1 - through) * exposure[:, 3] + through * NEW
    laid = np.rint(laid_over(view.image, opacity(view))) / 255
    return shown if view.mask is None else np.where(view.mask[:, :, None], shown, laid), laid


def gradient_of(color: NDArray[np.float64], exposure: NDArray[np.float64], view: View) -> NDArray[np.float64]:
    """Return the gradient of the loss with respect to the render (H, W, 3)."""
    v = reference_loss_gradient(*wanted_of(color, exposure, view))
    return (v if view.mask is None else v * view.mask[:, :, None]) @ exposure[:, :3]


def best_exposure(color: NDArray[np.float64], view: View, pull: float) -> NDArray[np.float64]:
    """Return the (3, 4) least-squares exposure. Additional rows pull it to the identity."""
    laid, through = wanted_of(color, np.eye(3, 4), view)[1], transparency(view)
    counts = (laid.max(axis=2) < 0.98) & (through[:, :, 0] < 1)
    if view.mask is not None:
        counts &= view.mask
    if not counts.any():
        return np.eye(3, 4)
    opaque = (1 - through)[counts]
    weight = np.sqrt(pull * np.square(opaque).sum())
    inputs = np.vstack([np.column_stack([(color - through * NEW)[counts], opaque]), weight * np.eye(4)])
    outputs = np.vstack([(laid - through * NEW)[counts], weight * np.eye(3, 4).T])
    return np.linalg.lstsq(inputs, outputs, rcond=None)[0].T


def some_exposures(n: int) -> NDArray[np.float64]:
    return np.tile(np.eye(3, 4), (n, 1, 1)) + 0.1 * np.random.default_rng(5).normal(size=(n, 3, 4))


def test_the_reference_gradient_is_that_of_differences() -> None:
    """Test exposure, mask and background at a pixel inside the mask and at one outside."""
    view = views_of(True, True)[0]
    assert view.mask is not None
    color, exposure = np.random.default_rng(0).random((*view.image.shape[:2], 3)), some_exposures(1)[0]
    v = gradient_of(color, exposure, view)
    assert 0 < view.mask.sum() < view.mask.size
    step = 1e-6
    for place in np.ndindex(*color.shape):
        ends = []
        for sign in (1, -1):
            moved = color.copy()
            moved[place] += sign * step
            ends.append(reference_loss(*wanted_of(moved, exposure, view)))
        assert v[place] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("usual", [[True] * 4, [True, False, True, True]], ids=["all", "three"])
@pytest.mark.parametrize(
    ("masks", "alphas", "real", "tolerance"),
    [(False, False, "float", 5e-5), (True, True, "float", 5e-5), (True, True, "double", ROUNDING)],
)
def test_gradients_and_step_equal_the_reference(
    scheduled: tuple[Device, Schedule], real: Real, tolerance: float, masks: bool, alphas: bool, usual: list[bool]
) -> None:
    """One target has no mask and one no opacity, among others that have them."""
    views = views_of(masks, alphas)
    device, schedule = scheduled
    exposure = photo_loss(device, schedule, real, views, exposure=True, usual=usual)
    dtype = exposure.kernels.dtype
    exposures = some_exposures(len(views))
    exposure.load_state({"exposure": exposures.reshape(-1, 12)})
    rate, pull = exposure.config.appearance.exposure_rate, exposure.config.appearance.exposure_pull
    for iteration, i in enumerate((0, 1, 2, 3, 0), 1):
        view = views[i]
        target = exposure.targets.get(i, 1)
        layout = target.layout
        color = np.random.default_rng(iteration).random((*view.image.shape[:2], 3)).astype(np.float32)
        rendered = DeviceImage(exposure.loss.pool, dtype, 3).write(layout, color)
        result = exposure.evaluate(target, rendered, NEW)
        exposure.step(i)
        planes = to_host(device, result.v_color, np.empty((3, layout.rows, layout.stride), dtype))
        v = gradient_of(color.astype(np.float64), exposures[i], view)
        found = layout.unpack(planes)
        assert relative_error(found, v) < tolerance
        np.testing.assert_array_equal(planes, layout.pack(found, dtype))  # the margin contains zeros
        if view.mask is not None:
            assert not found[~view.mask].any()
            assert found[view.mask].any()
        shown, laid = wanted_of(color.astype(np.float64), exposures[i], view)
        value = exposure.loss.value(result)
        assert value.total == pytest.approx(reference_loss(shown, laid), rel=1e-4)
        counts = np.ones(shown.shape[:2], bool) if view.mask is None else view.mask
        assert value.mse == pytest.approx(((shown - laid)[counts] ** 2).mean(), rel=1e-4)
        moved = rate * (best_exposure(color.astype(np.float64), view, pull) - exposures[i])
        exposures[i] += moved
        exposures -= moved / sum(usual) if usual[i] else 0
        np.testing.assert_allclose(exposure.exposures(), exposures, atol=1e-9 if real == "double" else 2e-5)
    kept, before = exposure.exposures()[usual], some_exposures(len(views))[usual]
    np.testing.assert_allclose(kept.mean(axis=0), before.mean(axis=0), atol=1e-6)


def test_exposures_and_random_backgrounds_need_the_opacity_of_photos() -> None:
    photos, opaque = views_of(False, True), views_of(False, False)
    assert target_channels(photos, TrainConfig(exposure=True)) == 5
    assert target_channels(photos, TrainConfig(random_background=True)) == 5
    assert target_channels(photos, TrainConfig()) == 3
    assert target_channels(opaque, TrainConfig(exposure=True, random_background=True)) == 3


def test_without_any_of_it_no_kernel_runs(device: Device) -> None:
    exposure = photo_loss(device, default_schedule(device.info), "float", views_of(False, False), exposure=False)
    assert not exposure.in_use
    assert exposure.targets.channels == 3
    np.testing.assert_array_equal(exposure.exposures(), np.tile(np.eye(3, 4), (4, 1, 1)))
    assert exposure.state() == {}


# --- learning ------------------------------------------------------------------------------


# Splats stay: new ones at iteration 100 would not be learned yet, and differ between the runs that are compared.
# L1 is not smooth: smooth L1 draws splats to the mean of the photos, which is nearly right here even without exposures.
CONFIG = TrainConfig(
    shape="skew-normal",
    iterations=200,
    cap_max=2500,
    sh_degree=0,
    coarse_to_fine=False,
    turnover=0.0,
    smooth_l1=0.0,
    seed=1,
)


def exposed(scene: Scene, gains: NDArray[np.float64]) -> Scene:
    """Return a scene whose training photos have gains around 0.75. The test photos have gain 0.75."""
    of = dict(zip([view.name for view in scene.train], 0.75 * gains, strict=True))
    views = [
        replace(view, image=np.rint(of.get(view.name, 0.75) * view.image).astype(np.uint8)) for view in scene.views
    ]
    return replace(scene, views=views)


def test_exposures_of_photos_are_found(scene: Scene) -> None:
    """The known gains of the photos have mean 1. Training learns the gains and improves views of gain 1."""
    n = len(scene.train)
    gains = np.random.default_rng(2).permutation(np.linspace(0.7, 1.3, n))
    changed = exposed(scene, gains)

    def trained(exposure: bool, seed: int) -> Trainer:
        trainer = Trainer(changed, replace(CONFIG, exposure=exposure, seed=seed))
        trainer.run()
        return trainer

    pairs = [(trained(False, seed), trained(True, seed)) for seed in range(3)]
    learned = pairs[0][1].exposure.exposures()
    np.testing.assert_allclose(learned.mean(axis=0), np.eye(3, 4), atol=1e-5)
    grey = 0.4
    of_grey = (grey * learned[:, :, :3].sum(axis=2) + learned[:, :, 3]).mean(axis=1) / grey
    assert np.corrcoef(of_grey, gains)[0, 1] > 0.95
    gains_of_psnr = [
        compensated.evaluate(changed.test).psnr - plain.evaluate(changed.test).psnr for plain, compensated in pairs
    ]
    assert np.mean(gains_of_psnr) > 0.3, "one seed of so short a run says little"


def test_a_few_dark_photos_do_not_move_the_colours_of_the_model(scene: Scene) -> None:
    """Without a rule for them, the test views would be darker or brighter than most photos."""
    gains = np.ones(len(scene.train))
    gains[1] = 0.25
    changed = exposed(scene, gains)
    trainer = Trainer(changed, replace(CONFIG, exposure=True))
    trainer.run()
    learned = trainer.exposure.exposures()
    np.testing.assert_allclose(np.delete(learned, 1, axis=0).mean(axis=0), np.eye(3, 4), atol=1e-5)
    of_grey = 0.4 * learned[:, :, :3].sum(axis=2) + learned[:, :, 3]
    assert (of_grey[1] < 0.75 * np.delete(of_grey, 1, axis=0).mean(axis=0)).all()


def test_what_a_mask_hides_is_not_learned(scene: Scene) -> None:
    """Add a magenta block at the left or the right of each photo, with and without a mask."""

    def blotted(view: View, side: int, masked: bool) -> View:
        height, width = view.image.shape[:2]
        hidden = np.zeros((height, width), bool)
        hidden[:, :: 2 * side - 1][height // 4 : 3 * height // 4, width // 8 : width // 2] = True
        image = np.where(hidden[:, :, None], np.array([255, 0, 255], np.uint8), view.image)
        return replace(view, image=image, mask=~hidden if masked else None)

    def magenta(image: NDArray[np.floating]) -> float:
        return float((image * [0.5, -1.0, 0.5]).sum(axis=2).mean())

    excess = {}
    for masked in (False, True):
        changed = replace(
            scene,
            views=[
                view if view.name in scene.test_names else blotted(view, i % 2, masked)
                for i, view in enumerate(scene.views)
            ],
        )
        model = Trainer(changed, CONFIG).run().splats
        excess[masked] = np.mean(
            [
                magenta(np.clip(Renderer().render(model, view.camera).color, 0, 1)) - magenta(view.image / 255)
                for view in changed.test
            ]
        )
    assert excess[False] > 0.02
    assert excess[True] < 0.2 * excess[False]


@pytest.mark.parametrize(("until", "n_random"), [(0.0, 0), (0.25, 2), (0.8, 8), (1.0, 10)])
def test_random_backgrounds_end(scene: Scene, monkeypatch: pytest.MonkeyPatch, until: float, n_random: int) -> None:
    own = (0.25, 0.5, 0.75)
    config = CONFIG.replace(
        iterations=10, background=own, random_background=True, random_background_until=until, average_last=0.0
    )
    trainer = Trainer(scene, config)
    used = []
    forward = trainer.pipeline.forward

    def recorded(splats: Any, camera: Any, background: Any, *others: Any) -> Any:
        used.append(background)
        return forward(splats, camera, background, *others)

    monkeypatch.setattr(trainer.pipeline, "forward", recorded)
    for _ in range(10):
        trainer.step()
    assert len(set(used[:n_random])) == n_random, "another colour in each iteration"
    assert own not in used[:n_random]
    assert used[n_random:] == [own] * (10 - n_random)


def test_random_backgrounds_show_through_nothing_opaque(scene: Scene) -> None:
    """Photos show a black object on transparent ground. Black splats match an empty render only over black."""

    def on_nothing(view: View) -> View:
        height, width = view.image.shape[:2]
        alpha = np.zeros((height, width), np.uint8)
        alpha[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 255
        return replace(view, image=np.zeros_like(view.image), alpha=alpha)

    views = [on_nothing(view) for view in scene.views]
    coverage = {}
    for random in (False, True):
        trainer = Trainer(replace(scene, views=views), replace(CONFIG, random_background=random))
        model = trainer.run().splats
        alpha = Renderer().render(model, views[1].camera).alpha
        inside = views[1].alpha > 0
        coverage[random] = alpha[inside].mean() - alpha[~inside].mean()
    assert coverage[True] > 0.5
    assert coverage[True] > coverage[False] + 0.3


def test_a_resumed_run_has_the_same_exposures(scene: Scene, tmp_path: Path) -> None:
    config = decide(scene, replace(CONFIG, iterations=40, exposure=True, random_background=True)).config
    whole = train(scene, config, output=tmp_path / "whole")
    trainer = Trainer(scene, config)
    for _ in range(23):
        trainer.step()
    trainer.checkpoint().save(tmp_path / "half.npz")
    resumed = Trainer(scene, config, Checkpoint.load(tmp_path / "half.npz"))
    splats = resumed.run().splats
    for name, array in whole.splats.arrays.items():
        np.testing.assert_array_equal(array, splats.arrays[name])
    stored = json.loads((tmp_path / "whole" / "exposure.json").read_text())
    assert stored == exposures_json([view.name for view in scene.train], resumed.exposure.exposures())


def test_exposure_json_multiplies_from_the_left() -> None:
    """3DGS multiplies the colour (3,) by the first three columns and adds the last."""
    exposure, colour = some_exposures(1), np.array([0.2, 0.5, 0.7])
    stored = np.array(exposures_json(["a"], exposure)["a"])
    np.testing.assert_allclose(colour @ stored[:, :3] + stored[:, 3], exposure[0, :, :3] @ colour + exposure[0, :, 3])


def test_a_run_begins_with_the_exposures_of_its_model(scene: Scene, tmp_path: Path) -> None:
    n = len(scene.train)
    changed = exposed(scene, np.linspace(0.8, 1.2, n))
    train(changed, replace(CONFIG, iterations=60, exposure=True), output=tmp_path / "first")
    folder = ModelFolder(tmp_path / "first")
    start = decide(scene, replace(CONFIG, iterations=10, exposure=True, init=str(folder.latest_ply()[0]))).config
    first = read_exposures(folder.exposures_path)
    assert {view.name for view in scene.train} == set(first)
    trainer = Trainer(changed, start)
    of_start = trainer.exposure.exposures()
    np.testing.assert_allclose(of_start, [first[view.name] for view in changed.train], atol=1e-6)
    trainer.run()
    assert not np.array_equal(trainer.exposure.exposures(), of_start)
    frozen = Trainer(changed, replace(start, exposure_rate=0.0))
    frozen.run()
    np.testing.assert_array_equal(frozen.exposure.exposures(), of_start)
    lost = {
        name: rows for name, rows in json.loads(folder.exposures_path.read_text()).items() if name != "view_003.png"
    }
    folder.exposures_path.write_text(json.dumps(lost))
    missing = Trainer(changed, start).exposure.exposures()
    np.testing.assert_array_equal(missing[[view.name == "view_003.png" for view in changed.train]], np.eye(3, 4)[None])


def test_exposures_are_read_as_they_were_written(tmp_path: Path) -> None:
    exposures = some_exposures(3)
    (tmp_path / "exposure.json").write_text(json.dumps(exposures_json(["a", "b", "c"], exposures)))
    found = read_exposures(tmp_path / "exposure.json")
    np.testing.assert_array_equal([found[name] for name in "abc"], exposures)


@pytest.mark.parametrize("rows", [[[1, 2], [3, 4]], "much", [[1.0, 0, 0, float("nan")]] * 3, [[10**400] * 4] * 3, None])
def test_a_damaged_file_of_exposures_is_refused(tmp_path: Path, rows: Any) -> None:
    (tmp_path / "exposure.json").write_text(json.dumps({"a.png": rows}))
    with pytest.raises(InputError, match=r"exposure\.json.*"):
        read_exposures(tmp_path / "exposure.json")


def test_on_the_command_line(tmp_path: Path, capture_folder: Path) -> None:
    folder = capture_folder
    clsplat(
        "train",
        folder,
        "-m",
        tmp_path / "model",
        "--iterations",
        10,
        "--cap-max",
        200,
        "--exposure",
        "--random-background",
        "-q",
    )
    assert len(json.loads((tmp_path / "model" / "exposure.json").read_text())) == len(load_scene(folder).views)
