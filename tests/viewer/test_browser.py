"""The viewer in a real browser: headless Chromium shows the scene, follows the mouse, and obeys the panel."""

from __future__ import annotations

import io
import shutil
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install clsplat[test-view])")

from playwright.sync_api import Page, sync_playwright

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.splats.splats import SH_C0, Splats
from clsplat.viewer.initial_view import SceneCameras, initial_view
from clsplat.viewer.server import Server
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource
from clsplat.viewer.viewer import Viewer

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")

# WebGL without a graphics card; root may not use the sandbox.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDTH, HEIGHT = 640, 480
FRONT = Camera(WIDTH, HEIGHT, 500.0, 500.0, WIDTH / 2, HEIGHT / 2, np.eye(4))


def wall() -> Splats:
    """Return a wall of splats four units ahead: red on the left, green on the right, brighter downwards."""
    y, x = np.mgrid[-1.5:1.5:25j, -2.0:2.0:33j]
    n = x.size
    colour = np.stack([x < 0, x >= 0, np.zeros_like(x)], axis=-1).reshape(n, 3) * (0.6 + 0.25 * y.reshape(n, 1))
    return Splats(
        "gaussian",
        {
            "mean": np.stack([x, y, np.full_like(x, 4.0)], axis=-1).reshape(n, 3).astype(np.float32),
            "quat": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            "log_scale": np.full((n, 3), np.log(0.1), np.float32),
            "opacity_logit": np.full(n, 6.0, np.float32),
            "sh": ((colour - 0.5) / SH_C0)[:, None].astype(np.float32),
        },
    )


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    source = ModelSource(wall())
    viewer = Viewer(source, Settings(background=(0.0, 0.0, 1.0)))
    aside = FRONT.posed([[0.0, 0.0, 1.0, -4.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 4.0]])
    known = SceneCameras((NamedCamera("front", FRONT),), (NamedCamera("aside", aside),))
    running = Server(viewer, initial_view(wall().mean, [FRONT]), known, port=0)
    worker = threading.Thread(target=viewer.run)
    worker.start()
    yield running
    viewer.close()
    running.close()
    worker.join()


@pytest.fixture(scope="module")
def page(server: Server) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(server.url)
        yield page
        browser.close()


def shot(page: Page) -> NDArray[np.uint8]:
    """Return the part of the window that neither the panel (right) nor a warning (above) covers."""
    return free(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")))


def free(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return picture[HEIGHT // 2 :, : WIDTH // 2 - 20].astype(int)


def like(shown: NDArray[np.uint8], picture: NDArray[np.uint8]) -> bool:
    """Whether two pictures are equal up to the resampling and JPEG of a browser."""
    return bool(np.abs(shown - free(picture)).mean() < 3.0)


def wait_for(page: Page, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Wait until the window shows a picture and return it."""
    for _ in range(100):
        if like(shown := shot(page), picture):
            return shown
        page.wait_for_timeout(100)
    raise AssertionError(f"the window differs by {np.abs(shown - free(picture)).mean():.1f}")


def test_it_shows_the_scene_and_follows_the_mouse(server: Server, page: Page) -> None:
    source = server.viewer.source
    front = source.picture(FRONT, Settings(background=(0.0, 0.0, 1.0)))
    shown = wait_for(page, front)
    assert shown[100, WIDTH // 4, 0] > 150, "red on the left"
    mouse = page.mouse
    mouse.move(150, 300)
    mouse.down()
    mouse.move(250, 300, steps=5)
    mouse.up()
    page.wait_for_timeout(1000)
    moved = shot(page)
    assert not like(moved, front)
    assert moved.reshape(-1, 3).std(axis=0).max() > 20, "no empty page"


@pytest.mark.slow
def test_it_jumps_to_a_camera_and_changes_what_is_shown(server: Server, page: Page) -> None:
    source = server.viewer.source
    jump = page.get_by_label("Jump to")
    jump.click()
    page.get_by_role("option", name="train 0: front").click()
    wait_for(page, source.picture(FRONT, Settings(background=(0.0, 0.0, 1.0))))
    show = page.get_by_label("Show", exact=True)
    show.click()
    page.get_by_role("option", name="Depth").click()
    wait_for(page, source.picture(FRONT, Settings(mode="depth", background=(0.0, 0.0, 1.0))))
