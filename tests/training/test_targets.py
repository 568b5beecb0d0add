"""Training images on the device: which are present, which stay, and which are uploaded again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import clsplat
from clsplat.device.device import Device
from clsplat.device.memory import to_host
from clsplat.device.schedule import default_schedule
from clsplat.device.trace import recorded
from clsplat.files.images import resize_area
from clsplat.rendering.build import KernelBuild
from clsplat.scenes.scene import View, load_scene
from clsplat.scenes.view import StoredView
from clsplat.training.config import TrainConfig
from clsplat.training.targets import Target, Targets, target_budget, target_bytes
from clsplat.training.trainer import Trainer

SIZES = [(40, 30), (17, 65), (64, 48), (40, 30)]  # width and height


def some_views() -> list[View]:
    rng = np.random.default_rng(0)
    return [
        View(
            f"{i}.png",
            clsplat.Camera(width, height, 25.0, 26.0, width / 2, height / 2, np.eye(4)),
            rng.integers(0, 256, (height, width, 3)).astype(np.uint8),
        )
        for i, (width, height) in enumerate(SIZES)
    ]


def targets_of(device: Device, budget: int) -> Targets:
    return Targets(device, KernelBuild("gaussian", 0, default_schedule(device.info)), some_views(), budget)


def image_of(targets: Targets, target: Target) -> NDArray[np.uint8]:
    """Read back the image (H, W, 3). Its margin must be zero."""
    layout = target.layout
    planes = to_host(targets.device, targets.planes(target), np.empty((3, layout.rows, layout.stride), np.uint8))
    image = layout.unpack(planes)
    np.testing.assert_array_equal(planes, layout.pack(image, np.dtype(np.uint8)))
    return image


@pytest.mark.parametrize("budget", [10**9, 20_000, 0])
def test_images_arrive_whatever_stays(device: Device, budget: int) -> None:
    """The test reads all views twice at each of three sizes. An image that stays is uploaded once."""
    targets = targets_of(device, budget)
    for downscale in (4, 2, 1):
        for again in range(2):
            for i, view in enumerate(targets.views):
                with recorded(device) as launches:
                    target = targets.get(i, downscale)
                    image = image_of(targets, target)
                size = (view.camera.width // downscale, view.camera.height // downscale)
                assert (target.camera.width, target.camera.height) == size
                np.testing.assert_array_equal(image, resize_area(view.image, *size))
                uploads = sum(launch.name == "upload" for launch in launches)
                if budget != 20_000:
                    assert uploads == int(not (again and budget))
        assert targets._kept_bytes <= budget


def test_part_of_the_images_stays(device: Device) -> None:
    """The images that are drawn first stay, within the budget."""
    targets = targets_of(device, 20_000)
    for i in range(4):
        image_of(targets, targets.get(i, 1))
    with recorded(device) as launches:
        for i in range(4):
            image_of(targets, targets.get(i, 1))
    assert 0 < sum(launch.name == "upload" for launch in launches) < 4


def test_images_of_the_last_size_are_given_back(device: Device) -> None:
    targets = targets_of(device, 10**9)
    held = []
    for downscale in (1, 4):
        for i in range(4):
            image_of(targets, targets.get(i, downscale))
        held.append(targets.nbytes)
    assert held[1] < 0.7 * held[0]


@pytest.mark.parametrize("budget", [10**9, 20_000, 0])
def test_what_is_promised_is_enough(device: Device, budget: int) -> None:
    targets = targets_of(device, budget)
    for i in (2, 0, 1, 3):  # the largest first, so that buffers need not grow
        image_of(targets, targets.get(i, 1))
    assert targets.nbytes <= target_bytes(targets.views, budget)
    assert target_budget(device) == device.info.global_mem_bytes // 4


def test_photos_are_in_memory_once(devices: list[Device], capture_folder: Path) -> None:
    """The memory of a CPU is that of the host: views give up their pixels to the device, and decode them again."""
    scene, config = load_scene(capture_folder), TrainConfig(iterations=30, cap_max=300, sh_degree=1)
    models = []
    for _ in range(2):
        trainer = Trainer(scene, config, device=devices[0])
        views = [view for view in scene.train if isinstance(view, StoredView)]
        assert len(views) == len(scene.train) <= 15
        assert all(view.is_kept for view in views)
        models.append(trainer.run().splats)
        assert any(view.is_kept for view in views) == (devices[0].info.type != "CPU")
    for name, array in models[0].arrays.items():
        np.testing.assert_array_equal(array, models[1].arrays[name])


def test_photos_that_do_not_fit_stay_with_their_views(devices: list[Device], capture_folder: Path) -> None:
    scene = load_scene(capture_folder)
    trainer = Trainer(scene, TrainConfig(iterations=30, cap_max=300, sh_degree=1), device=devices[0])
    trainer.targets.budget = 0
    trainer.run()
    assert all(isinstance(view, StoredView) and view.is_kept for view in scene.train)


def test_training_does_not_depend_on_what_stays(devices: list[Device], capture_folder: Path) -> None:
    """The results are equal to the bit with all images on the device and with none."""
    scene = load_scene(capture_folder)
    config = TrainConfig(iterations=10, cap_max=300, sh_degree=1)
    models = []
    for kept in (True, False):
        trainer = Trainer(scene, config, device=devices[0])
        if not kept:
            trainer.targets.budget = 0
        models.append(trainer.run().splats)
    for name, array in models[0].arrays.items():
        np.testing.assert_array_equal(array, models[1].arrays[name])
