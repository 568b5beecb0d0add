"""The web server with real connections: its address, several browsers, broken connections, malformed messages."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from reference.scenes import for_shape, random_camera, random_splats
from serving import serving

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")

from viewer_client import Client
from websockets.exceptions import ConnectionClosed

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.cameras.path import path_of
from clsplat.errors import OutputError
from clsplat.files.images import write_png
from clsplat.rendering.renderer import Renderer
from clsplat.splats.splats import Splats
from clsplat.viewer import listen, page, status_line
from clsplat.viewer.access import Access
from clsplat.viewer.camera import Pose, camera_of
from clsplat.viewer.crop import CropBox
from clsplat.viewer.crop_panel import CropPanel
from clsplat.viewer.initial_view import SceneCameras, initial_view
from clsplat.viewer.legend import legend
from clsplat.viewer.page import Page
from clsplat.viewer.server import Server
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource
from clsplat.viewer.status_line import StatusLine, plain
from clsplat.viewer.viewer import Viewer

# The server silences these warnings of viser, but pytest has its own filters.
pytestmark = [pytest.mark.filterwarnings("ignore:Queued a"), pytest.mark.filterwarnings(r"ignore:\[viser\]")]

LABELS = ("Show", "Background", "Jump to", "Seconds a key")
BACKGROUND = (0.0, 0.0, 1.0)


def model(n: int = 40) -> Splats:
    return Splats("skew-normal", for_shape(random_splats(3, n, 3, np.float32), "skew-normal"))


class Running:
    """A server and the thread that serves it."""

    def __init__(self, folder: Path) -> None:
        self.source = ModelSource(model())
        self.viewer = Viewer(self.source, Settings(background=BACKGROUND))
        cameras = [NamedCamera(f"view_{seed}", random_camera(seed)) for seed in range(3)]
        self.reloads = 0
        self.server = Server(
            self.viewer,
            initial_view(model().mean, [item.camera for item in cameras]),
            SceneCameras(tuple(cameras[:2]), tuple(cameras[2:])),
            port=0,
            reload=self.reload,
            folder=folder,
        )
        self._open = ExitStack()
        self._open.enter_context(serving(self.viewer, self.server))

    def reload(self) -> str:
        self.reloads += 1
        return f"read again *{self.reloads}*"

    def close(self) -> None:
        self._open.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    started = Running(tmp_path_factory.mktemp("paths"))
    yield started
    started.close()


def expected(settings: Settings, position: tuple[float, float, float] = (0, 0, -3)) -> np.ndarray:
    camera = camera_of(Pose((1, 0, 0, 0), position, 1.0, 96, 64), 1000)
    assert camera is not None
    return ModelSource(model()).picture(camera, settings)


def close_to(shown: np.ndarray, picture: np.ndarray) -> bool:
    """Whether two pictures are equal up to the losses of JPEG."""
    return shown.shape == picture.shape and bool(np.abs(shown.astype(int) - picture).mean() < 4.0)


def shows(client: Client, picture: np.ndarray) -> bool:
    """Whether a browser soon gets this picture."""
    end = time.monotonic() + 10.0
    while not (client.pictures and close_to(client.last(), picture)):
        if time.monotonic() > end:
            return False
        client.receive(0.1)
    return True


def test_a_busy_port_is_one_line(running: Running) -> None:
    refused = r"127\.0\.0\.1:\d+: cannot listen on this address \(.*in use\); choose another --port"
    with pytest.raises(OutputError, match=refused):
        Server(Viewer(running.source), initial_view(model().mean, []), port=running.server.port)
    with socket.socket() as other:  # another program that listens on the port
        other.bind(("0.0.0.0", 0))
        other.listen()
        with pytest.raises(OutputError, match="cannot listen on this address"):
            Server(Viewer(running.source), initial_view(model().mean, []), port=other.getsockname()[1])


@pytest.mark.parametrize("host", ["256.1.1.1", "192.0.2.1", "no.such.host.invalid"])
def test_an_address_that_is_not_ours_is_one_line(running: Running, host: str) -> None:
    with pytest.raises(OutputError, match="cannot listen on this address"):
        Server(Viewer(running.source), initial_view(model().mean, []), host=host, port=0)


def test_a_browser_sees_the_render(running: Running) -> None:
    with Client(running.server.port) as client:
        client.look()
        assert shows(client, expected(Settings(background=BACKGROUND)))
        client.look((0, 0, -5))
        assert shows(client, expected(Settings(background=BACKGROUND), (0, 0, -5)))
        assert not close_to(client.last(), expected(Settings(background=BACKGROUND)))


def test_two_browsers_see_what_each_has_chosen(running: Running) -> None:
    with Client(running.server.port) as one, Client(running.server.port) as two:
        one.look()
        two.look()
        one.set("Show", "Depth")
        two.set("Background", [255, 0, 0])
        assert shows(one, expected(Settings(mode="depth", background=BACKGROUND)))
        assert shows(two, expected(Settings(background=(1.0, 0.0, 0.0))))
        two.set("Splats", 5)
        two.set("SH degree", 0)
        assert shows(two, expected(Settings(background=(1.0, 0.0, 0.0), cap=5, sh_degree=0)))
        one.set("Resolution", 64)
        one.still((43, 64))


def test_a_setting_chosen_at_once_is_taken(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser may use the panel as soon as it shows it."""

    class Slow(CropPanel):
        def __init__(self, *values: Any) -> None:
            time.sleep(0.3)  # a busy machine
            super().__init__(*values)

    monkeypatch.setattr(page, "CropPanel", Slow)
    with Client(running.server.port) as client:
        client.look()
        client.set("Background", [255, 0, 0])
        assert shows(client, expected(Settings(background=(1.0, 0.0, 0.0))))


def test_lines_that_break_in_mid_frame_harm_nobody(running: Running) -> None:
    with Client(running.server.port) as steady:
        steady.look()
        steady.still()
        for number in range(6):
            client = Client(running.server.port)
            client.look((0, 0, -3 - number))
            client.receive(1.0)
            client.look((0, 0, -4 - number))
            client.vanish() if number % 2 else client.close()
        steady.look((0, 0, -4))
        assert shows(steady, expected(Settings(background=BACKGROUND), (0, 0, -4)))
        for _ in range(50):
            if running.viewer.count == 1:
                break
            steady.drain(0.1)
        assert running.viewer.count == 1, "those who have gone are forgotten"


SENSELESS = [
    {"type": "ViewerCameraMessage", "wxyz": "x", "position": None},
    {"type": "GuiUpdateMessage", "uuid": "Show", "updates": {"value": "../../etc/passwd"}},
    {"type": "GuiUpdateMessage", "uuid": "Show", "updates": {"no such": 1}},
    {"type": "GuiUpdateMessage", "uuid": "nobody", "updates": {"value": 1}},
    {"type": "GuiUpdateMessage", "uuid": "Background", "updates": {"value": [1e9, "a", 2]}},
    {"type": "GuiUpdateMessage", "uuid": "Jump to", "updates": {"value": "/etc/passwd"}},
    {"type": "GuiUpdateMessage", "uuid": "Seconds a key", "updates": {"value": float("nan")}},
    {"type": "ShareUrlRequest"},
    {"type": "NoMessage"},
    b"\xff\x00 no message",
]


def test_senseless_messages_change_nothing(running: Running, capfd: pytest.CaptureFixture[str]) -> None:
    """A malformed message ends at most the connection that sent it."""
    for message in SENSELESS:
        with Client(running.server.port) as client:
            client.look()
            client.picture()
            if isinstance(message, bytes):
                client.send_raw(message)
            else:
                client.send(message | ({"uuid": client.uuid(message["uuid"])} if message.get("uuid") in LABELS else {}))
            with contextlib.suppress(ConnectionClosed):
                client.drain(0.05)
    with Client(running.server.port) as client:
        client.look()
        assert shows(client, expected(Settings(background=BACKGROUND)))
        assert running.viewer.settings == Settings(background=BACKGROUND)
    assert "Traceback" not in "".join(capfd.readouterr())


ABSURD: list[dict[str, Any]] = [
    {"position": (float("nan"), 0, 0)},
    {"position": (1e300, 0, 0)},
    {"fov": float("nan")},
    {"fov": 1e9},
    {"fov": -1.0},
    {"width": 10**12, "height": -4},
    {"width": 0, "height": 0},
    {"wxyz": (0, 0, 0, 0)},
    {"wxyz": (float("inf"),) * 4},
]


def test_absurd_cameras_harm_nobody(running: Running) -> None:
    with Client(running.server.port) as client:
        for camera in ABSURD:
            client.look(**camera)
            client.picture()
        client.look()
        assert shows(client, expected(Settings(background=BACKGROUND)))


def test_an_absurd_camera_sees_the_background(running: Running) -> None:
    with Client(running.server.port) as client:
        client.look(fov=3.1)
        assert shows(client, np.broadcast_to((0, 0, 255), (64, 96, 3)))


def test_the_panel_jumps_to_cameras(running: Running) -> None:
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Jump to", "test 0: view_2")
        client.drain(0.3)
        moved = [m for m in client.received if m["type"] == "SetCameraPositionMessage" and not m.get("initial")]
        assert np.allclose(moved[-1]["position"], random_camera(2).position)
        client.set("Show cameras", True)
        client.drain(0.3)
        assert sum(m["type"] == "CameraFrustumMessage" for m in client.received) == 3


def test_a_path_is_recorded_and_saved(running: Running, tmp_path: Path) -> None:
    folder = running.server._folder
    assert folder is not None
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Download", True)
        client.until("add two or more")
        for step in range(3):
            client.look((step, 0, -3))
            client.still()
            client.set("Add a key", True)
            client.until(f"{step + 1} key")
        client.set("Save", True)
        client.until(plain("camera_path_001.json"))
        client.set("Play", True)
        walked: list[float] = []
        while len(walked) < 5:
            assert client.receive(5.0)
            walked = [
                message["position"][0]
                for message in client.received
                if message["type"] == "SetCameraPositionMessage" and not message["initial"]
            ]
        client.set("Stop", True)
        assert walked == sorted(walked)
        assert 0.0 < walked[-1] < 2.0
        client.set("Download", True)
        client.drain(0.3)
        started = [m for m in client.received if m["type"] == "FileTransferStartDownload"]
        content = b"".join(bytes(m["content"]) for m in client.received if m["type"] == "FileTransferPart")
    assert started[0]["filename"] == "camera_path.json"
    path = path_of(json.loads(content), "download")
    assert content == (folder / "camera_path_001.json").read_bytes()
    assert len(path.keys) == 3
    assert np.allclose(path.cameras[-1].position, (2, 0, -3), atol=1e-6)
    assert [file.name for file in folder.iterdir()] == ["camera_path_001.json"]


def test_reading_again_is_said_plainly(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_line, "READING_TIME", 60.0)
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Read the file again", True)
        client.until(plain("read again *1*"))
        client.look((0, 0, -4))
        client.still()
        client.drain(0.5)
        assert plain("read again *1*") in client.texts(), "frames leave a message for some seconds"


def test_nothing_of_a_message_is_markup() -> None:
    text, escaped = "a*b_c <i>\n[x](y)", r"a\*b\_c \<i\> \[x\]\(y\)"
    assert plain(text) == escaped
    shown: list[str] = []
    page, server = Page.__new__(Page), Server.__new__(Server)
    page._status, server._panel = StatusLine(shown.append), (SimpleNamespace(content=""), None)
    page.set_status(text)
    server.set_training_status(text)
    assert shown == [server._panel[0].content] == [escaped]


@pytest.mark.slow
def test_the_benchmark_runs(tmp_path: Path, model_folder: Path) -> None:
    model, out = model_folder, tmp_path / "viewer.jsonl"
    command = [
        sys.executable,
        str(Path(__file__).parents[2] / "benchmarks" / "viewer.py"),
        "--scenes",
        model.name,
        "--models",
        str(model.parent),
        "--windows",
        "320x240",
        "--seconds",
        "0.5",
        "--out",
        str(out),
    ]
    subprocess.run(command, check=True, capture_output=True)
    (row,) = [json.loads(line) for line in out.read_text().splitlines()]
    assert row["fps_moving"] > 1
    assert 0 < row["latency_ms"]["median"] <= row["latency_ms"]["p95"]
    assert {"device", "driver", "schedule", "commit", "splats"} <= set(row)


def downloads(client: Client) -> dict[str, bytes]:
    """Return the files that a client has received, by name."""
    client.drain(0.3)
    started = [m for m in client.received if m["type"] == "FileTransferStartDownload"]
    parts = [m for m in client.received if m["type"] == "FileTransferPart"]
    return {
        start["filename"]: b"".join(
            bytes(part["content"]) for part in parts if part["transfer_uuid"] == start["transfer_uuid"]
        )
        for start in started
    }


def test_a_picture_is_the_file_that_render_writes(running: Running, tmp_path: Path) -> None:
    """It is larger than the window, and has the settings of the client."""
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Background", [255, 0, 0])
        client.set("Picture size", 300)
        client.set("Download picture", True)
        client.set("Download picture", True)
        end = time.monotonic() + 10.0
        while not downloads(client) and time.monotonic() < end:
            pass
        ((name, content), *_) = downloads(client).items()
    assert name == "view_001.png"
    camera = camera_of(Pose((1, 0, 0, 0), (0, 0, -3), 1.0, 96, 64), 300, enlarge=True)
    assert camera is not None
    assert (camera.width, camera.height) == (300, 200)
    write_png(tmp_path / "view.png", Renderer().render(model(), camera, (1.0, 0.0, 0.0)).color, render=True)
    assert content == (tmp_path / "view.png").read_bytes()


def test_the_field_of_view_follows_the_slider_and_the_slider_follows_it(running: Running) -> None:
    with Client(running.server.port) as client:
        client.look(fov=1.0)
        client.still()
        client.drain(0.2)
        slider = client.panel[client.uuid("Field of view")]
        assert slider["value"] == 57.5
        client.set("Field of view", 90.0)
        client.drain(0.3)
        changed = [m["fov"] for m in client.received if m["type"] == "SetCameraFovMessage" and not m.get("initial")]
        assert changed == [pytest.approx(np.pi / 2)]
        client.look(fov=np.pi / 2 + 1e-3)  # the browser's answer; the slider shows it already
        client.still()
        client.look(fov=0.5)
        client.drain(0.3)
        assert client.panel[client.uuid("Field of view")]["value"] == 28.5
        assert len([m for m in client.received if m["type"] == "SetCameraFovMessage" and not m.get("initial")]) == 1


def test_depth_has_a_legend(running: Running) -> None:
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Show", "Depth")
        client.still()
        client.drain(0.3)
        bars = [
            props["content"] for props in client.panel.values() if "depth [world units]" in props.get("content", "")
        ]
        view = running.source.view(_front(), Settings(mode="depth", background=BACKGROUND))
        assert bars == [legend("depth", view.near_far)]
        client.set("Show", "Colour")
        client.still()
        client.drain(0.3)
        assert not depth_bars(client)


def depth_bars(client: Client) -> list[str]:
    contents = [str(props.get("content", "")) for props in client.panel.values()]
    return [content for content in contents if "depth [world units]" in content]


def _front() -> Camera:
    camera = camera_of(Pose((1, 0, 0, 0), (0, 0, -3), 1.0, 96, 64), 1000)
    assert camera is not None
    return camera


def test_a_box_hides_what_is_outside_and_its_splats_are_saved(running: Running) -> None:
    folder = running.server._folder
    assert folder is not None
    splats = model()
    with Client(running.server.port) as client:
        client.look()
        client.still()
        client.set("Save PLY", True)
        client.until(plain("box: set Crop first"))
        client.set("Crop", True)
        client.until("of 40 splats are inside")
        client.set("Size", [2.0, 3.0, 2.5])
        client.drain(0.3)
        controls = next(m for m in client.received if m["type"] == "TransformControlsMessage")
        first = controls["name"]
        pose = {
            "type": "TransformControlsUpdateMessage",
            "name": first,
            "owner": controls["owner"],
            "wxyz": [1.0, 0.0, 0.0, 0.0],
            "position": [0.0, 0.0, 0.5],
        }
        client.send(pose)
        box = CropBox.of((0, 0, 0.5), (1, 0, 0, 0), (2.0, 3.0, 2.5))
        kept = splats.select(box.contains(splats.mean))
        assert 0 < len(kept) < 40
        client.until(f"{len(kept)} of 40 splats are inside")
        assert shows(client, expected(Settings(background=BACKGROUND, crop=box)))
        for number in (1, 2):
            client.set("Save PLY", True)
            client.until(plain(f"cropped_00{number}.ply"))
        client.set("Download PLY", True)
        client.until(plain("cropped.ply:"))
        content = downloads(client)["cropped.ply"]
        client.send(pose | {"name": f"{first}/corner", "position": [0.5, 0.25, 1.0]})
        client.until(f"{CropBox.of((0, 0, 0.5), (1, 0, 0, 0), (1, 0.5, 2)).contains(splats.mean).sum()} of 40 splats")
        client.set("Size", [-1.0, 1.0, 1.0])
        client.set("Crop", False)
        assert shows(client, expected(Settings(background=BACKGROUND)))
    kept.save(folder / "expected.ply")
    for name in ("cropped_001.ply", "cropped_002.ply"):
        assert (folder / name).read_bytes() == (folder / "expected.ply").read_bytes() == content
        (folder / name).unlink()
    (folder / "expected.ply").unlink()


def test_on_windows_the_port_of_another_program_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """SO_REUSEADDR, which skips a wait on other systems, takes the port from the program that listens there."""
    options: list[int] = []

    class Probe(socket.socket):
        def setsockopt(self, level: int, option: int, value: Any) -> None:
            options.append(option)

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        monkeypatch.setattr(socket, "SO_EXCLUSIVEADDRUSE", -5, raising=False)
        monkeypatch.setattr(socket, "socket", Probe)
        with pytest.raises(OutputError, match=f"127.0.0.1:{port}: cannot listen on this address"):
            listen.open_server("127.0.0.1", port, Access(frozenset({"127.0.0.1"})))
    assert options == [-5]
