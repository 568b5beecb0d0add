"""The web page in a real browser: headless Chromium draws what clsplat renders, and follows mouse, touch and keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install clsplat[test-view])")

from playwright.sync_api import Browser, Page
from viewer_browser import CHROMIUM, canvas_picture, chromium, shown

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.evaluation.metrics import psnr
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.splats.shapes import shape_named
from clsplat.splats.splats import Splats
from clsplat.webpage.page import PageContent, write_web_page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")

WIDTH, HEIGHT = 320, 240
BACKGROUND = (0.2, 0.4, 0.6)
FULL, COMPACT = 60.0, 45.0  # lowest PSNR against the renderer [dB]
SETTLED = "page.settled"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


def scene(
    shape: str, degree: int = 3, *, shrink: float = 1.0, zoom: float = 1.0, **options: Any
) -> tuple[Splats, list[NamedCamera]]:
    """Return 3000 random splats in a ball, and cameras around it with an off-centre principal point.

    shrink : divides the sizes of the splats. zoom : factor of the focal lengths.
    """
    made, splats = synthetic_scene(3000, WIDTH, HEIGHT, shape, degree)
    arrays = splats.to_numpy()
    arrays["log_scale"] -= np.float32(np.log(shrink))
    moved = [
        Camera(WIDTH, HEIGHT, zoom * c.fx, 1.1 * zoom * c.fy, c.cx + 9, c.cy - 7, c.cam_from_world)
        for c in (view.camera for view in made.views)
    ]
    cameras = [NamedCamera(f"photo {i}", camera) for i, camera in enumerate(moved)]
    return Splats(shape, arrays, **options), cameras


def opened(browser: Browser, path: Path, content: tuple[Splats, list[NamedCamera]], precision: str = "full") -> Page:
    """Write a page, open it in a window of the cameras' size, and wait for its picture."""
    splats, cameras = content
    write_web_page(path, splats, PageContent("ball", cameras, background=BACKGROUND), precision)
    page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, has_touch=True).new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_function(SETTLED)
    assert not errors
    return page


def rendered(splats: Splats, camera: Camera) -> NDArray[np.float32]:
    return np.clip(Renderer().render(splats, camera, BACKGROUND).color, 0, 1).astype(np.float32)


@pytest.mark.parametrize(
    ("shape", "degree", "options"),
    [
        ("gaussian", 3, {}),
        ("gaussian", 0, {"antialiased": True, "shrink": 10.0}),
        ("gaussian", 1, {"zoom": 4.0}),
        ("skew-normal", 3, {}),
        ("skew-normal", 2, {"normalisation": "pdf", "near_plane": 2.0}),
        ("skew-normal", 1, {"normalisation": "none"}),
        ("generalised-exponential", 2, {}),
        ("generalised-exponential", 0, {"antialiased": True, "shrink": 10.0}),
        ("skew-normal", 3, {"antialiased": True, "shrink": 10.0}),
        ("skew-normal", 0, {"antialiased": True, "shrink": 10.0, "low_pass": 0.1}),
        ("gaussian", 0, {"shrink": 10.0, "low_pass": 0.1}),
    ],
    ids=str,
)
def test_the_page_draws_what_clsplat_renders(
    browser: Browser, tmp_path: Path, shape: str, degree: int, options: dict[str, Any]
) -> None:
    content = scene(shape, degree, **options)
    splats, cameras = content
    with opened(browser, tmp_path / "ball.html", content) as page:
        for number, named in enumerate(cameras[:3]):
            page.evaluate(f"page.jump({number})")
            expected = rendered(splats, named.camera)
            assert expected.std() > 0.04
            assert psnr(canvas_picture(page), expected) > FULL


@pytest.mark.parametrize(
    ("shape", "options"),
    [("skew-normal", {"normalisation": "pdf"}), ("generalised-exponential", {}), ("gaussian", {"zoom": 3.0})],
    ids=str,
)
def test_splats_outside_of_the_view_are_left_out(
    browser: Browser, tmp_path: Path, shape: str, options: dict[str, Any]
) -> None:
    """Many are, inside the ball. The picture has the bits of one with all splats."""
    content = scene(shape, 1, **options)
    with opened(browser, tmp_path / "ball.html", content) as page:
        page.evaluate("page.controls.pose.position = page.middle; page.moved()")
        shown = canvas_picture(page)
        assert 100 < page.evaluate("page.renderer.count") < 0.6 * len(content[0])
        page.evaluate(
            """() => { const { columns, head } = page.renderer.payload, huge = columns.opacity.map(() => 1e6);
            const all = { mean: columns.mean, reach: { factor: huge, size: huge }, near: head.near_plane };
            page.renderer.setOrder(makeSorter(all)(page.view)); page.draw(1, performance.now()); }"""
        )
        more = page.evaluate("page.renderer.count")
        assert more > page.evaluate("makeSorter(page.sorter.splats)(page.view).length")
        assert shown.std() > 0.04
        np.testing.assert_array_equal(canvas_picture(page), shown)


def test_compact_pages_are_close_and_python_reads_what_the_browser_reads(browser: Browser, tmp_path: Path) -> None:
    content = scene("skew-normal")
    camera = content[1][0].camera
    with opened(browser, tmp_path / "ball.html", content, "compact") as page:
        shown = canvas_picture(page)
    assert psnr(shown, rendered(content[0], camera)) > COMPACT
    assert psnr(shown, rendered(Splats.load(tmp_path / "ball.html"), camera)) > FULL


@pytest.fixture(scope="module")
def ball(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with opened(browser, tmp_path_factory.mktemp("page") / "ball.html", scene("skew-normal")) as page:
        yield page


@pytest.fixture
def page(ball: Page) -> Page:
    """The page of the ball, at its first camera."""
    ball.evaluate("page.jump(0)")
    ball.wait_for_function(SETTLED)
    return ball


def pose(page: Page) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    found = page.evaluate("page.controls.pose")
    position, axes = np.array(found["position"]), np.array(found["axes"])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(axes) > 0
    return position, axes


def target(page: Page) -> NDArray[np.float64]:
    return np.array(page.evaluate("page.controls.target"))


def test_the_page_begins_with_the_first_camera_and_names_all(page: Page) -> None:
    assert page.title() == "ball"
    assert page.locator("#loading").is_hidden()
    assert page.locator("#cameras option").all_inner_texts() == [f"photo {i}" for i in range(6)]
    assert "3,000 splats" in page.locator("#info").inner_text()


def test_a_drag_turns_around_the_middle(page: Page) -> None:
    (before, _), middle, first = pose(page), target(page), canvas_picture(page)
    page.mouse.move(160, 120)
    page.mouse.down()
    page.mouse.move(220, 120, steps=3)
    page.mouse.up()
    after, axes = pose(page)
    np.testing.assert_allclose(target(page), middle, atol=1e-6)
    assert np.linalg.norm(after - middle) == pytest.approx(np.linalg.norm(before - middle), rel=1e-5)
    assert np.linalg.norm(after - before) > 0.1
    assert axes[2] @ (middle - after) > 0
    assert psnr(canvas_picture(page), first) < 30


def test_the_wheel_comes_closer_and_the_right_button_moves_sideways(page: Page) -> None:
    (before, axes), middle = pose(page), target(page)
    page.mouse.move(160, 120)
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(100)
    closer, _ = pose(page)
    assert np.linalg.norm(closer - middle) < 0.9 * np.linalg.norm(before - middle)
    page.mouse.down(button="right")
    page.mouse.move(190, 120)
    page.mouse.up(button="right")
    aside, _ = pose(page)
    assert (aside - closer) @ axes[0] < -0.01, "the scene follows the hand"
    np.testing.assert_allclose(target(page) - middle, aside - closer, atol=1e-6)


def wait_until(page: Page, done: Callable[[], bool]) -> None:
    """Wait for a key that is held to take effect. A busy machine draws the first frame late."""
    for _ in range(100):
        page.wait_for_timeout(100)
        if done():
            return


def test_keys_fly_and_look(page: Page) -> None:
    before, axes = pose(page)
    page.locator("#view").focus()
    page.keyboard.down("w")
    wait_until(page, lambda: (pose(page)[0] - before) @ axes[2] > 0.05)
    page.keyboard.up("w")
    ahead, _ = pose(page)
    assert (ahead - before) @ axes[2] > 0.05
    page.keyboard.down("ArrowRight")
    wait_until(page, lambda: pose(page)[1][2] @ axes[0] > 0.05)
    page.keyboard.up("ArrowRight")
    still, turned = pose(page)
    np.testing.assert_allclose(still, ahead, atol=1e-6)
    assert turned[2] @ axes[0] > 0.05


@pytest.mark.parametrize("button", ["#next", "#reset", "#tour"])
def test_keys_work_after_a_click_on_a_button(page: Page, button: str) -> None:
    page.locator(button).click()
    page.keyboard.down("w")
    assert page.evaluate("page.controls.keys.size") == 1
    page.keyboard.up("w")
    index = page.evaluate("page.index")
    page.keyboard.press(".")
    assert page.evaluate("page.index") != index
    page.keyboard.press("r")


def test_keys_work_after_a_choice_in_the_list_by_pointer(page: Page) -> None:
    """Who walks through the list by keys stays there."""
    cameras = page.locator("#cameras")
    cameras.focus()
    page.keyboard.press("ArrowDown")
    assert page.evaluate("page.index") == 1
    assert page.evaluate("document.activeElement.id") == "cameras"
    page.keyboard.down("d")
    assert page.evaluate("page.controls.keys.size") == 0, "letters choose in the list"
    page.keyboard.up("d")
    page.evaluate("""() => {
        const list = document.getElementById("cameras");
        list.dispatchEvent(new PointerEvent("pointerdown"));
        list.value = 2;
        list.dispatchEvent(new Event("change"));
    }""")
    assert page.evaluate("page.index") == 2
    assert page.evaluate("document.activeElement.id") == "view"
    page.keyboard.press("r")


@pytest.mark.parametrize("between", ["Control", "h", "focus", "tour"])
def test_a_key_that_is_released_elsewhere_is_released(page: Page, between: str) -> None:
    page.locator("#view").focus()
    page.keyboard.down("w")
    assert page.evaluate("page.controls.keys.size") == 1
    if between == "focus":
        page.locator("select").first.focus()
    elif between == "tour":
        page.locator("#tour").click()
    else:
        page.keyboard.down(between)
    page.keyboard.up("w")
    assert page.evaluate("page.controls.keys.size") == 0
    if between in ("Control", "h"):
        page.keyboard.up(between)
    page.keyboard.press("Escape")
    if page.locator("#tour").get_attribute("aria-pressed") == "true":
        page.locator("#tour").click()


def test_one_finger_turns_and_two_come_closer(page: Page) -> None:
    touch = """([fingers, moves]) => { const view = page.canvas;
        view.setPointerCapture = () => {};
        const send = (kind, id, x, y) => view.dispatchEvent(new PointerEvent(kind,
            {pointerId: id, pointerType: "touch", clientX: x, clientY: y, bubbles: true}));
        fingers.forEach(([x, y], id) => send("pointerdown", id + 5, x, y));
        moves.forEach(([id, x, y]) => send("pointermove", id + 5, x, y));
        fingers.forEach(([x, y], id) => send("pointerup", id + 5, x, y)); }"""
    before, middle = pose(page)[0], target(page)
    page.evaluate(touch, [[[160, 120]], [[0, 200, 120]]])
    turned = pose(page)[0]
    assert np.linalg.norm(turned - middle) == pytest.approx(np.linalg.norm(before - middle), rel=1e-5)
    assert np.linalg.norm(turned - before) > 0.05
    page.evaluate(touch, [[[140, 120], [180, 120]], [[0, 120, 120], [1, 200, 120]]])
    assert page.evaluate("page.controls.distance") == pytest.approx(0.5 * np.linalg.norm(turned - middle), rel=1e-3)


def test_buttons_go_to_cameras_and_tour(page: Page) -> None:
    first = pose(page)[0]
    page.locator("#next").click()
    assert page.locator("#cameras").input_value() == "1"
    second = pose(page)[0]
    assert not np.allclose(first, second)
    page.locator("#previous").click()
    np.testing.assert_allclose(pose(page)[0], first)
    page.locator("#cameras").select_option("3")
    assert not np.allclose(pose(page)[0], first)
    page.locator("#reset").click()
    np.testing.assert_allclose(pose(page)[0], first)
    page.locator("#tour").click()
    page.wait_for_timeout(500)
    assert page.locator("#tour").get_attribute("aria-pressed") == "true"
    assert not np.allclose(pose(page)[0], first)
    page.locator("#tour").click()
    assert page.locator("#tour").get_attribute("aria-pressed") == "false"


def test_the_background_shines_through_where_splats_do(page: Page) -> None:
    before = canvas_picture(page)
    page.locator("#background").fill("#ff0000")
    change = canvas_picture(page) - before
    page.locator("#background").fill("#336699")
    assert change[..., 0].max() > 0.3
    np.testing.assert_allclose(change, change[..., :1] * (np.array([0.8, -0.4, -0.6]) / 0.8), atol=0.01)


def test_a_double_click_makes_a_place_the_middle(page: Page) -> None:
    before = pose(page)[0]
    page.mouse.dblclick(170, 110)
    page.wait_for_timeout(100)
    after, axes = pose(page)
    np.testing.assert_allclose(after, before, atol=1e-6)
    ahead = target(page) - after
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), axes[2], atol=1e-6)


def test_help_lists_the_keys(page: Page) -> None:
    page.locator("#view").focus()
    page.keyboard.press("H")  # as with Shift, or Caps Lock
    assert page.locator("#help").is_visible()
    assert "3,000 splats" in page.locator("#about").inner_text()
    page.keyboard.press("Escape")
    assert page.locator("#help").is_hidden()


def test_a_slow_device_gets_smaller_images_while_it_moves(page: Page) -> None:
    page.evaluate("page.share = 1; page.changed = false; page.adapt(200)")
    assert page.evaluate("page.share") < 0.6
    page.evaluate("for (let i = 1; i < 60; ++i) page.adapt(20);")
    assert page.evaluate("page.share") == 1
    page.evaluate("page.share = 0.5; page.changed = true")
    page.wait_for_function(f"page.renderer.size[0] < {WIDTH}")
    page.wait_for_function(SETTLED)
    assert page.evaluate("page.renderer.size") == [WIDTH, HEIGHT], "a view at rest has its full size"


def test_a_picture_takes_the_time_until_the_device_has_finished_it(page: Page) -> None:
    """A picture of seconds returns at once: a fence is signaled when it is there. Pictures at rest do not count."""
    script = """() => {
      const renderer = page.renderer, gl = renderer.gl, real = gl.getSyncParameter;
      const before = [renderer.drawing, renderer.done];
      let signaled = new Set();
      gl.getSyncParameter = (sync) => signaled.has(sync) ? gl.SIGNALED : gl.UNSIGNALED;
      [renderer.drawing, renderer.done] = [[], 100];
      const found = [];
      renderer.note(1000, true);
      found.push(renderer.poll(1017), renderer.drawing.length);
      renderer.note(1017, true);
      signaled.add(renderer.drawing[0].sync);
      found.push(renderer.poll(4000), renderer.drawing.length);
      signaled.add(renderer.drawing[0].sync);
      found.push(renderer.poll(6000), renderer.drawing.length);
      renderer.note(7000, true);
      renderer.note(7010, true);
      renderer.drawing.forEach(({ sync }) => signaled.add(sync));
      found.push(renderer.poll(7100));
      renderer.note(8000, false);
      signaled.add(renderer.drawing[0].sync);
      found.push(renderer.poll(9000));
      delete gl.getSyncParameter;
      [renderer.drawing, renderer.done] = before;
      return found;
    }"""
    assert page.evaluate(script) == [None, 1, 3000, 1, 2000, 0, 50, None]


def test_the_smallest_images_have_fewer_splats_on_a_slow_device(page: Page) -> None:
    page.evaluate("page.frame = () => {}")  # no picture changes the sizes in between
    try:
        page.evaluate("page.part = 1; page.share = SMALLEST; page.adapt(200)")
        assert page.evaluate("page.share") == page.evaluate("SMALLEST")
        assert page.evaluate("FEWEST < page.part && page.part < 1")
        page.evaluate("for (let i = 1; i < 60; ++i) page.adapt(200);")
        assert page.evaluate("page.part === FEWEST")
        page.evaluate("page.adapt(20)")
        assert page.evaluate("page.part > FEWEST && page.share === SMALLEST"), "the splats come back first"
        page.evaluate("for (let i = 1; i < 90; ++i) page.adapt(20);")
        assert page.evaluate("[page.part, page.share]") == [1, 1]
    finally:
        page.evaluate("delete page.frame; requestAnimationFrame((now) => page.frame(now))")


def test_a_view_at_rest_has_all_its_splats(page: Page) -> None:
    whole, shown = page.evaluate("page.renderer.count"), canvas_picture(page)
    page.evaluate("page.share = SMALLEST; page.part = FEWEST; page.changed = true")
    page.wait_for_function(f"page.renderer.count < {whole}")
    page.wait_for_function(SETTLED)
    assert page.evaluate("[page.renderer.count, page.whole]") == [whole, True]
    np.testing.assert_array_equal(canvas_picture(page), shown)


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_faintest_splats_are_left_out_first(browser: Browser, tmp_path: Path, antialiased: bool) -> None:
    """The weight of a splat is its opacity times its length on the smallest image, widened by the low pass."""
    content = scene("gaussian", 0, antialiased=antialiased)
    with opened(browser, tmp_path / "ball.html", content) as page:
        view = page.evaluate("page.view")
        order, kept = page.evaluate(
            "[1, 0.6].map((part) => [...makeSorter(page.sorter.splats)([...page.view.slice(0, -1), part])])"
        )
    arrays = content[0].to_numpy()
    depth = (arrays["mean"][order] - np.array(view[9:12])) @ np.array(view[6:9])
    length = np.exp(arrays["log_scale"][order].max(axis=1)) / depth / view[16]
    opacity = 1 / (1 + np.exp(-arrays["opacity_logit"][order].ravel().astype(np.float64)))
    weight = opacity * np.sqrt(length**2 + (0.0 if antialiased else 0.3))
    stays = np.isin(order, kept)
    assert list(np.array(order)[stays]) == kept, "from far to near"
    assert 0.6 * len(order) <= len(kept) < 0.61 * len(order)
    assert weight[stays].min() > 0.99 * weight[~stays].max()


@pytest.mark.parametrize("shape", ["skew-normal", "generalised-exponential"])
def test_smaller_images_leave_out_faint_pixels(browser: Browser, tmp_path: Path, shape: str) -> None:
    """Half of the splats show no pixel above 1/64. Only the picture at full size has them."""
    splats, cameras = scene(shape, 0)
    arrays = splats.to_numpy()
    faint = np.arange(len(splats)) % 2 == 0
    arrays["opacity_logit"][faint] = shape_named(shape).raw_opacity(np.float32(0.013))
    bright = Splats(shape, {name: array[~faint] for name, array in arrays.items()})
    with opened(browser, tmp_path / "all.html", (Splats(shape, arrays), cameras)) as page:
        whole, half = canvas_picture(page), below_full_size(page)
    with opened(browser, tmp_path / "bright.html", (bright, cameras)) as page:
        assert np.abs(canvas_picture(page) - whole).max() > 0.02
        np.testing.assert_array_equal(below_full_size(page), half)
    assert psnr(half, whole) > 22


def below_full_size(page: Page) -> NDArray[np.float32]:
    """Return the picture of an image at half the size."""
    page.evaluate("page.frame = () => {}")  # nothing draws it at full size then
    page.evaluate("page.draw(0.5, 0)")
    return shown(page)


@pytest.mark.parametrize(
    ("without", "said"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "This browser has no WebGL 2"),
        ("delete window.DecompressionStream", "This browser is too old for the page"),
    ],
)
def test_old_browsers_are_told(browser: Browser, tmp_path: Path, without: str, said: str) -> None:
    splats, cameras = scene("gaussian")
    write_web_page(tmp_path / "ball.html", splats, PageContent("ball", cameras))
    with browser.new_page() as page:
        page.add_init_script(without)
        page.goto((tmp_path / "ball.html").as_uri())
        page.wait_for_selector(f"#loading-text:has-text('{said}')")


@pytest.mark.parametrize(
    "worker",
    ["constructor() { throw new Error('no workers'); }", "postMessage() { setTimeout(() => this.onerror?.(), 50); }"],
)
def test_a_page_works_without_workers(browser: Browser, tmp_path: Path, worker: str) -> None:
    splats, cameras = scene("gaussian")
    write_web_page(tmp_path / "ball.html", splats, PageContent("ball", cameras, background=BACKGROUND), "full")
    with browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}) as page:
        page.add_init_script(f"window.Worker = class {{ {worker} }}")
        page.goto((tmp_path / "ball.html").as_uri())
        assert psnr(canvas_picture(page), rendered(splats, cameras[0].camera)) > FULL


def test_a_damaged_page_says_so(browser: Browser, tmp_path: Path) -> None:
    splats, cameras = scene("gaussian")
    path = tmp_path / "ball.html"
    write_web_page(path, splats, PageContent("ball", cameras))
    text = path.read_text()
    start = text.index('id="payload"') + 400
    path.write_text(text[:start] + text[start + 400 :])
    page = browser.new_page()
    page.goto(path.as_uri())
    page.wait_for_function("document.getElementById('loading-bar').hidden")
    assert page.locator("#loading-text").inner_text()
