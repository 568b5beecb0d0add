"""`clsplat view` and `clsplat train --view`: the pictures they show, and their messages for bad input."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cli_runner import ITERATIONS, MODEL_RUN, N_VIEWS, SHORT, TEST_NAMES, clsplat, error_of, run
from PIL import Image

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera, write_cameras
from clsplat.models.model import SceneChoice, load_model
from clsplat.training.run import Model
from clsplat.viewer.camera import Pose, camera_of
from clsplat.viewer.session import known_cameras
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource


def test_a_still_picture_has_the_bytes_of_render(tmp_path: Path, model_folder: Path) -> None:
    model = model_folder
    position = tuple(known_cameras(load_model(model)).test[0].camera.position)
    camera = camera_of(Pose((0.9, 0.1, -0.3, 0.2), position, 0.9, 130, 70), 1280)
    assert isinstance(camera, Camera)
    write_cameras(tmp_path / "cameras.json", [NamedCamera("browser", camera)])
    clsplat("render", model, "--cameras", tmp_path / "cameras.json", "-o", tmp_path / "out", "--background", "0.2,0,1")
    shown = ModelSource(load_model(model).splats).picture(camera, Settings(background=(0.2, 0.0, 1.0)))
    assert np.array_equal(shown, np.asarray(Image.open(tmp_path / "out" / "browser.png")))
    assert len(np.unique(shown)) > 50


def test_cameras_are_split_as_the_run_did(capture_folder: Path, model_folder: Path) -> None:
    model = load_model(model_folder)
    scene = capture_folder
    for known in (known_cameras(model), known_cameras(model, SceneChoice(scene, resolution=2))):
        assert [item.name for item in known.test] == [name.removesuffix(".png") for name in TEST_NAMES]
        assert len(known.train) == N_VIEWS - len(TEST_NAMES)
    ply = load_model(model.ply)
    assert not known_cameras(ply).by_label


def test_bad_input_is_one_line(tmp_path: Path, capture_folder: Path, model_folder: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    model, scene = model_folder, capture_folder
    assert "no such model folder or file of splats" in error_of("view", tmp_path / "none")
    assert "give one model folder" in error_of("view", code=2)
    assert "no iteration 7" in error_of("view", model, "--iteration", "7")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert f"127.0.0.1:{port}: cannot listen on this address" in error_of("view", model, "--port", port)
        refused = error_of("train", scene, "-m", tmp_path / "run", "--view", "--port", port, *SHORT)
        assert f"127.0.0.1:{port}: cannot listen on this address" in refused
        assert not (tmp_path / "run").exists()
    assert "--view shows one run" in error_of("train", scene, "--view", "--budget", "auto", code=2)


def test_without_viser_both_say_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capture_folder: Path, model_folder: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install clsplat[view]" in error_of("view", model_folder)
    assert "pip install clsplat[view]" in error_of("train", capture_folder, "-m", tmp_path / "run", "--view", *SHORT)
    assert not (tmp_path / "run").exists()


def test_the_page_stays_after_training_only_where_somebody_can_end_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capture_folder: Path
) -> None:
    """Here standard error is not a terminal, as in a script."""
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    from clsplat.viewer.training_session import TrainingSession

    stayed: list[int] = []

    def stay(session: TrainingSession, model: Model) -> None:
        stayed.append(model.iteration)
        raise KeyboardInterrupt

    monkeypatch.setattr(TrainingSession, "stay", stay)
    short = [*SHORT, "--iterations", 12, "--view", "--port", 0]
    quiet = run("train", capture_folder, "-m", tmp_path / "ends", *short)
    assert quiet.exit_code == 0
    assert not stayed
    result = run("train", capture_folder, "-m", tmp_path / "stays", *short, "--stay")
    assert result.exit_code == 0
    assert stayed == [12]
    assert re.search(
        r"the page stays open at http://127\.0\.0\.1:\d+ until Ctrl-C; later: clsplat view ", result.stderr
    )
    assert "--stay and --no-stay need --view" in error_of("train", capture_folder, "--stay", code=2)


class Command:
    """Run `clsplat ...` in a process that serves a page."""

    def __init__(self, *args: object) -> None:
        command = [
            sys.executable,
            "-u",
            "-c",
            "from clsplat_cli.start import main; main()",
            *(str(arg) for arg in args),
        ]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"COLUMNS": "200"}
        )
        self.said = ""
        assert self.process.stdout is not None
        while not (found := re.search(r"http://localhost:(\d+)|http://127\.0\.0\.1:(\d+)", self.said)):
            line = self.process.stdout.readline()
            assert line, self.said
            self.said += line
        self.port = int(found[1] or found[2])

    def end(self) -> int:
        """Send Ctrl-C to a process."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.stdout is not None
        self.said += self.process.stdout.read()
        return self.process.wait(20)


@pytest.fixture
def viewing(tmp_path: Path, model_folder: Path) -> Iterator[tuple[Command, Path]]:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    ply = tmp_path / "model.ply"
    ply.write_bytes(load_model(model_folder).ply.read_bytes())
    command = Command("view", ply, "--port", 0)
    yield command, ply
    if command.process.poll() is None:
        command.process.kill()


@pytest.mark.slow
def test_view_shows_a_file_that_changes_and_ends_with_ctrl_c(viewing: tuple[Command, Path]) -> None:
    from viewer_client import Client

    from clsplat.viewer.status_line import plain

    command, ply = viewing
    whole, some = ply.read_bytes(), load_model(ply).splats.select(range(50))
    with Client(command.port) as client:
        client.look((0, 0, -3))
        first = client.still()
        ply.write_bytes(whole[:-100])
        client.until("the previous model stays")
        client.look((0, 0, -3))
        assert np.abs(client.still().astype(int) - first).mean() < 2.0
        some.save(ply)
        client.until(plain("50 splats"))
    assert command.end() == 0
    assert "Traceback" not in command.said
    assert len(command.said.splitlines()) == 1, command.said


def test_both_models_of_a_comparison_are_read_again(tmp_path: Path, model_folder: Path) -> None:
    pytest.importorskip("viser")
    from clsplat.viewer.options import ServerOptions
    from clsplat.viewer.session import ViewingSession

    files = [tmp_path / "one.ply", tmp_path / "other.ply"]
    splats = load_model(model_folder).splats
    for file in files:
        splats.save(file)
    session = ViewingSession(load_model(files[0]), options=ServerOptions(port=0), against=load_model(files[1]))
    try:
        shown = [source for _, source in session.watched]
        for number, file in enumerate(files):
            splats.select(np.arange(10 + number)).save(file)
            session.poll()  # a file is read once it has stayed the same
            session.poll()
            assert len(shown[number].splats) == 10 + number
        splats.select(np.arange(7)).save(files[1])
        assert session.reload() == "one.ply: read again, 10 splats; other.ply: read again, 7 splats"
        files[1].unlink()
        assert "other.ply: does not exist any more; the previous model stays" in session.reload()
        assert len(shown[1].splats) == 7
    finally:
        session.close()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf_8_are_shown_as_escapes(tmp_path: Path, model_folder: Path) -> None:
    """viser's messages are UTF-8. The browser would get no panel."""
    pytest.importorskip("viser")
    from clsplat.viewer.initial_view import SceneCameras
    from clsplat.viewer.options import ServerOptions
    from clsplat.viewer.session import ViewingSession

    file = Path(os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff.ply"))
    load_model(model_folder).splats.save(file)
    camera = NamedCamera("a\udcff", Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(4)))
    session = ViewingSession(load_model(file), SceneCameras((camera,)), options=ServerOptions(port=0))
    try:
        assert session.server._name == r"bad\udcff"
        assert list(SceneCameras((camera,)).by_label) == [r"train 0: a\udcff"]
    finally:
        session.close()


@pytest.mark.slow
def test_train_view_shows_the_run(tmp_path: Path, capture_folder: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    from viewer_client import Client

    options = [*SHORT[2:], "--iterations", 100000]
    command = Command("train", capture_folder, "-m", tmp_path / "run", "--view", "--port", 0, *options)
    try:
        client = Client(command.port)
        client.look((0, 0, -3))
        client.until("iteration ", 30.0)
        shown = client.picture(30.0)
        assert shown.ndim == 3
        client.set("Pause", True)
        client.drain(0.5)
        log = tmp_path / "run" / "log.jsonl"
        time.sleep(0.3)
        before = log.read_text()
        client.look((0, 0.5, -3))
        client.still()
        assert log.read_text() == before
        client.set("Resume", True)
        client.vanish()
        while log.read_text() == before:
            time.sleep(0.05)
        assert command.end() == 130
        assert "to continue: clsplat train --resume" in command.said
        assert "Traceback" not in command.said
    finally:
        if command.process.poll() is None:
            command.process.kill()


@pytest.mark.slow
def test_a_watched_model_has_the_same_bits(tmp_path: Path, capture_folder: Path, model_folder: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")
    model = model_folder
    clsplat("train", capture_folder, "-m", tmp_path / "run", "--view", "--port", 0, *MODEL_RUN)
    name = Path("point_cloud") / f"iteration_{ITERATIONS}" / "point_cloud.ply"
    assert (tmp_path / "run" / name).read_bytes() == (model / name).read_bytes()
