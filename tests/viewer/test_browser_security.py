"""Pages of other origins in a real browser: they get no picture and cannot pause a run."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from serving import serving

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install clsplat[test-view])")

import viser
from playwright.sync_api import Browser, Page
from viewer_browser import CHROMIUM, chromium, wall

from clsplat.viewer.initial_view import initial_view
from clsplat.viewer.server import Server
from clsplat.viewer.source import ModelSource
from clsplat.viewer.viewer import Viewer

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")

EVIL = "evil.example"
# What a foreign page can try: a websocket with viser's protocol, and reading the page.
ATTACK = f"""async ([address, seconds]) => {{
  const result = {{opened: false, messages: 0, page: ""}};
  const socket = new WebSocket("ws://" + address, ["viser-v{viser.__version__}"]);
  socket.onopen = () => {{ result.opened = true; }};
  socket.onmessage = () => {{ result.messages += 1; }};
  const closed = new Promise(resolve => {{ socket.onclose = resolve; }});
  await Promise.race([closed, new Promise(resolve => setTimeout(resolve, 1000 * seconds))]);
  try {{ result.page = await (await fetch("http://" + address + "/")).text(); }} catch (error) {{}}
  return result;
}}"""
NOTHING = {"opened": False, "messages": 0, "page": ""}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    viewer = Viewer(ModelSource(wall()))
    running = Server(viewer, initial_view(wall().mean, []), port=0)
    running.add_training(lambda: pytest.fail("a foreign page has paused the run"))
    with serving(viewer, running):
        yield running


@pytest.fixture(scope="module")
def other_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A web server with an empty page."""
    folder = tmp_path_factory.mktemp("foreign")
    (folder / "index.html").write_text("<!doctype html><title>foreign</title>")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(folder))  # type: ignore[arg-type]

        def log_message(self, *args: object) -> None: ...

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        yield web.server_port
        web.shutdown()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium(f"--host-resolver-rules=MAP {EVIL} 127.0.0.1") as running:
        yield running


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 320, "height": 240})
    yield context.new_page()
    context.close()


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", EVIL])
def test_a_page_of_another_origin_gets_nothing(server: Server, other_port: int, page: Page, name: str) -> None:
    page.goto(f"http://{name}:{other_port}/")
    assert page.evaluate(ATTACK, [f"127.0.0.1:{server.port}", 3]) == NOTHING
    assert page.evaluate(ATTACK, [f"localhost:{server.port}", 3]) == NOTHING
    assert not server.viewer.count


def test_a_name_that_resolves_to_this_machine_gets_nothing(server: Server, page: Page) -> None:
    """DNS rebinding: the viewer under a foreign name would be of the foreign page's origin."""
    answer = page.goto(f"http://{EVIL}:{server.port}/")
    assert answer is not None
    assert answer.status == 403
    result = page.evaluate(ATTACK, [f"{EVIL}:{server.port}", 3])
    assert not result["opened"]
    assert result["page"].startswith("403")


def test_a_foreign_page_cannot_show_the_viewer_in_a_frame(server: Server, other_port: int, page: Page) -> None:
    page.goto(f"http://localhost:{other_port}/")
    page.evaluate(
        """address => new Promise(resolve => {
            const frame = document.createElement("iframe");
            frame.src = "http://" + address + "/";
            frame.onload = resolve;
            document.body.append(frame);
        })""",
        f"localhost:{server.port}",
    )
    page.wait_for_timeout(500)
    assert page.frames[1].url.startswith("chrome-error:")
    assert not server.viewer.count


def test_the_page_of_a_token_connects(server: Server, page: Page, tmp_path: Path) -> None:
    """The printed address of a viewer for other machines works, and its token leaves the address bar."""
    shared = Server(server.viewer, initial_view(wall().mean, []), host="0.0.0.0", port=0)
    try:
        page.goto(f"http://127.0.0.1:{shared.port}/")
        assert "403: the token is missing" in page.content()
        page.goto(shared.url.replace("localhost", "127.0.0.1"))
        for _ in range(100):
            if server.viewer.count:
                break
            page.wait_for_timeout(100)
        assert server.viewer.count == 1
        assert shared.access.token not in page.url
    finally:
        page.goto("about:blank")
        shared.close()
