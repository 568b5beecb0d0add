"""The viewer in a real browser: headless Chromium shows the scene, follows the mouse, and obeys the panel."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from serving import serving

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install clsplat[test-view])")

from playwright.sync_api import Page
from viewer_browser import CHROMIUM, chromium, wall
from viser import CameraHandle, ClientHandle

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.splats.splats import Splats
from clsplat.viewer.compared import ComparedSource
from clsplat.viewer.initial_view import SceneCameras, initial_view
from clsplat.viewer.page import HELP
from clsplat.viewer.server import Server
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource
from clsplat.viewer.viewer import Viewer

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")

WIDTH, HEIGHT = 640, 480
FRONT = Camera(WIDTH, HEIGHT, 500.0, 500.0, WIDTH / 2, HEIGHT / 2, np.eye(4))


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    source = ModelSource(wall())
    viewer = Viewer(source, Settings(background=(0.0, 0.0, 1.0)))
    aside = FRONT.posed([[0.0, 0.0, 1.0, -4.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 4.0]])
    known = SceneCameras((NamedCamera("front", FRONT),), (NamedCamera("aside", aside),))
    running = Server(viewer, initial_view(wall().mean, [FRONT]), known, port=0)
    with serving(viewer, running):
        yield running


@pytest.fixture(scope="module")
def page(server: Server) -> Iterator[Page]:
    with chromium() as browser:
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(server.url)
        while not server.server.get_clients():
            page.wait_for_timeout(100)
        yield page


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


def test_a_slow_browser_shows_full_size_after_a_move(page: Page) -> None:
    """viser lowers its resolution while a slow machine draws; a still page never draws enough to raise it again."""
    session = page.context.new_cdp_session(page)
    session.send("Emulation.setCPUThrottlingRate", {"rate": 3})
    page.keyboard.down("ArrowRight")  # the camera turns in every frame
    page.wait_for_timeout(4000)
    page.keyboard.up("ArrowRight")
    session.send("Emulation.setCPUThrottlingRate", {"rate": 1})
    assert page.evaluate("document.querySelector('canvas[data-engine]').width") == WIDTH


class Reports:
    """The page's last report of its camera: unlike viser's handle, nothing that the server sets."""

    def __init__(self, camera: CameraHandle) -> None:
        self.wxyz, self.position = camera.wxyz, camera.position
        camera.on_update(self.take)

    async def take(self, camera: CameraHandle) -> None:
        """viser calls a coroutine at once, but a function in a thread, which may already see what the server set."""
        self.wxyz, self.position = camera.wxyz, camera.position


def stand_at_the_origin(page: Page, client: ClientHandle, reports: Reports) -> None:
    """Set the camera until the page reports it for a second: on a busy machine, a late report may undo what was set."""
    forwards, origin = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    still = 0
    for _ in range(100):
        if still == 0:
            client.camera.wxyz, client.camera.position = forwards, origin
            client.flush()
        page.wait_for_timeout(200)
        at_rest = np.allclose(np.abs(reports.wxyz), forwards, atol=1e-3) and np.allclose(reports.position, 0, atol=1e-3)
        still = still + 1 if at_rest else 0
        if still == 5:
            return
    raise AssertionError(f"the page's camera stays at {reports.position}, {reports.wxyz}")


def test_keys_do_what_the_help_says(server: Server, page: Page) -> None:
    """The keys are viser's. World axes here: x right, y down, z forward."""
    lines = ("**W S** | forwards, backwards", "**A D** | left, right", "**E Q** | up, down")
    assert all(line in HELP for line in lines)
    (client,) = server.server.get_clients().values()
    reports = Reports(client.camera)
    page.mouse.click(150, 400)
    for key, axis, sign in (("w", 2, 1), ("s", 2, -1), ("a", 0, -1), ("d", 0, 1), ("e", 1, -1), ("q", 1, 1)):
        stand_at_the_origin(page, client, reports)
        page.keyboard.down(key)
        for _ in range(100):
            page.wait_for_timeout(100)
            if np.abs(reports.position).max() > 0.05:
                break
        page.keyboard.up(key)
        moved = reports.position
        assert sign * moved[axis] > 0.05, (key, moved)
        assert abs(moved[axis]) > 5 * np.abs(np.delete(moved, axis)).max(), (key, moved)


def test_the_model_is_downloaded_as_a_web_page(page: Page, tmp_path: Path) -> None:
    with page.expect_download() as download:
        page.get_by_role("button", name="Download web page").click()
    assert download.value.suggested_filename == "view.html"
    download.value.save_as(tmp_path / "view.html")
    np.testing.assert_allclose(Splats.load(tmp_path / "view.html").mean, wall().mean, atol=1e-4)
    text = (tmp_path / "view.html").read_text()
    assert '"name": "front"' in text
    assert '"name": "aside"' in text
    assert '"background": [0.0, 0.0, 1.0]' in text


def test_a_distance_is_measured_by_two_clicks(server: Server, page: Page) -> None:
    """The wall is 4 units ahead of a camera with 500 px for a unit at the distance of one."""
    (client,) = server.server.get_clients().values()
    stand_at_the_origin(page, client, Reports(client.camera))
    page.get_by_text("Measure", exact=True).click()
    for _ in range(2):  # a second press begins anew: it does not make two points of each click
        page.get_by_role("button", name="Measure a distance").click()
        page.wait_for_timeout(500)
    focal = 0.5 * HEIGHT / np.tan(0.5 * client.camera.fov)
    for x in (60, 260):
        page.mouse.click(x, 300)
        page.wait_for_timeout(1500)
    wanted = 200 / focal * 4
    found = page.get_by_text("units of the model").first.text_content()
    assert found is not None
    assert float(found.split()[-5] if found.startswith("distance") else found.split()[0]) == pytest.approx(
        wanted, rel=0.03
    )
    length = page.get_by_label("Real length")
    length.fill("2.5")
    length.press("Enter")
    page.get_by_text("2.5 in real").first.wait_for()


@pytest.mark.slow
def test_a_divider_moves_between_two_models(page: Page) -> None:
    dark = wall().with_arrays(wall().to_numpy() | {"sh": np.full_like(wall().sh, -1.0)})
    source = ComparedSource(ModelSource(wall()), ModelSource(dark), ("bright", "dark_one"))
    viewer = Viewer(source, Settings(background=(0.0, 0.0, 1.0)))
    running = Server(
        viewer, initial_view(wall().mean, [FRONT]), SceneCameras((NamedCamera("front", FRONT),), ()), port=0
    )
    assert page.context.browser is not None
    with serving(viewer, running):
        page = page.context.browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(running.url)
        page.get_by_text("bright | dark_one").wait_for()
        wait_for(page, source.view(FRONT, Settings(background=(0.0, 0.0, 1.0))).picture)
        number = page.locator(
            "input[type=text][value='0.5']"
        )  # beside the slider, whose keys would also move the camera
        number.fill("0.25")
        page.keyboard.press("Enter")
        wait_for(page, source.view(FRONT, Settings(background=(0.0, 0.0, 1.0), divider=0.25)).picture)
        page.close()
