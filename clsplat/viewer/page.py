"""The panel of one browser: settings, cameras to jump to, a path to record."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import viser
from viser import transforms

from ..cameras.camera import Camera
from ..cameras.cameras_json import NamedCamera
from ..cameras.path import CameraPath
from ..errors import ClsplatError
from .camera import Pose, camera_of
from .initial_view import SceneCameras, vertical_fov
from .recording import FILE_NAME, MAX_SECONDS, Recording
from .settings import MAX_SIZE, MIN_SIZE
from .viewer import Viewer, ViewerImage

QUALITY, MOVING_QUALITY = 95, 80  # JPEG quality of still and of moving frames
_STATUS_INTERVAL = 0.5  # seconds between changes of the status line while moving
_TRAIN, _TEST = (110, 170, 255), (255, 160, 60)
_NO_CAMERA = "–"
_MODES = {"colour": "Colour", "depth": "Depth", "alpha": "Alpha", "splats": "Splats a pixel", "skew": "Skew magnitude"}


class Page:
    """The panel of one browser.

    Parameters
    ----------
    reload : reads the model file again and returns a status text, or None if there is no file.
    folder : folder for saved paths, or None if paths can only be downloaded.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        viewer: Viewer,
        known: SceneCameras,
        reload: Callable[[], str] | None = None,
        folder: Path | None = None,
    ) -> None:
        self.client, self.viewer, self.known = client, viewer, known
        self._reload, self._folder = reload, folder
        self._cameras = known.by_label
        self._recording = Recording()
        self._playing: threading.Event | None = None
        self._rates: list[float] = []
        self._status_time = 0.0
        self._frusta: list[viser.CameraFrustumHandle] = []
        self._status = client.gui.add_markdown("")
        self._add_settings()
        if known.by_label:
            self._add_cameras()
        self._add_path()
        viewer.join(client.client_id, self.send)
        self._moved(client.camera)
        client.camera.on_update(self._on_camera)

    def close(self) -> None:
        """Remove the client after the browser has gone."""
        self.viewer.leave(self.client.client_id)
        self._stop()

    def send(self, frame: ViewerImage) -> None:
        """Show a frame; the serving thread calls this."""
        self.client.scene.set_background_image(
            frame.picture, format="jpeg", jpeg_quality=QUALITY if frame.still else MOVING_QUALITY
        )
        self.client.flush()
        now = time.monotonic()
        self._rates = [*(moment for moment in self._rates if now - moment < 1.0), now]
        if frame.still or frame.message or now - self._status_time > _STATUS_INTERVAL:
            self._status_time = now
            height, width = frame.picture.shape[:2]
            rate = "" if frame.still else f", {len(self._rates)} a second"
            self.set_status(
                frame.message
                or f"{self.viewer.source.n_splats} splats, {width} × {height} px, {1e3 * frame.seconds:.0f} ms{rate}"
            )

    def set_status(self, text: str) -> None:
        """Set the status line at the top of the panel."""
        self._status.content = plain(text)

    def model_changed(self) -> None:
        """Adapt the slider of splats to the new model."""
        n = self.viewer.source.n_splats
        everything = self._cap.value >= self._cap.max
        self._cap.max, self._cap.step = max(n, 1), _step(n)
        if everything or self._cap.value > n:
            self._cap.value = max(n, 1)

    def _add_settings(self) -> None:
        gui, viewer, source = self.client.gui, self.viewer, self.viewer.source
        chosen = viewer.settings_of(self.client.client_id)
        with gui.add_folder("View"):
            labels = {label: mode for mode, label in _MODES.items() if mode in source.modes}
            mode = gui.add_dropdown("Show", tuple(labels), hint="The property of the splats that is shown")
            mode.on_update(lambda _: self._choose("mode", labels.get(mode.value)))
            r, g, b = (round(255 * part) for part in chosen.background)
            ground = gui.add_rgb("Background", (r, g, b))
            ground.on_update(lambda _: self._choose("background", ground.value))
            size = gui.add_slider(
                "Resolution",
                MIN_SIZE,
                MAX_SIZE,
                64,
                chosen.size,
                hint="Longest side of a still frame in pixels; moving frames adapt",
            )
            size.on_update(lambda _: self._choose("size", size.value))
            if source.sh_degree:
                degree = gui.add_slider(
                    "SH degree", 0, source.sh_degree, 1, source.sh_degree, hint="Bands of view-dependent colour"
                )
                degree.on_update(lambda _: self._choose("sh_degree", degree.value))
            n = max(source.n_splats, 1)
            self._cap: Any = gui.add_slider(
                "Splats",
                0,
                n,
                _step(n),
                n,
                hint="Number of splats shown; those that cover most come first",
                visible=source.partial,
            )
            self._cap.on_update(lambda _: self._choose("cap", self._cap.value))
            if self._reload is not None:
                button = gui.add_button("Read the file again", icon=viser.Icon.REFRESH)
                button.on_click(lambda _: self._do_reload())

    def _add_cameras(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Cameras"):
            shown = gui.add_checkbox(
                "Show cameras", False, hint="Blue: training; orange: test. Click a camera to jump to it"
            )
            shown.on_update(lambda _: self._show_cameras(shown.value))
            jump = gui.add_dropdown("Jump to", (_NO_CAMERA, *self._cameras))
            jump.on_update(lambda _: self._jump(self._cameras.get(jump.value)))

    def _add_path(self) -> None:
        gui, recording = self.client.gui, self._recording
        with gui.add_folder("Camera path", expand_by_default=False):
            keys = gui.add_markdown("No keys")

            def changed(done: Callable[[], object]) -> Callable[[object], None]:
                def on_click(_: object) -> None:
                    self._try(done)
                    n = len(recording.keys)
                    keys.content = f"{n or 'No'} {'key' if n == 1 else 'keys'}"

                return on_click

            gui.add_button("Add a key", icon=viser.Icon.PLUS).on_click(changed(self._add_key))
            gui.add_button("Remove the last key").on_click(changed(recording.remove_last))
            gui.add_button("Remove all keys").on_click(changed(recording.clear))
            seconds = gui.add_slider("Seconds a key", 0.5, 10.0, 0.5, recording.seconds)
            seconds.on_update(lambda _: self._pace(seconds.value))
            closed = gui.add_checkbox("Closed", False, hint="Go back to the first key")
            closed.on_update(lambda _: setattr(recording, "closed", bool(closed.value)))
            gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY).on_click(lambda _: self._try(self._play))
            gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP).on_click(lambda _: self._stop())
            download = gui.add_button(
                "Download", icon=viser.Icon.DOWNLOAD, hint="As camera_path.json, for clsplat render --path"
            )
            download.on_click(lambda _: self._try(self._download))
            if self._folder is not None:
                save = gui.add_button(
                    "Save", icon=viser.Icon.DEVICE_FLOPPY, hint="Into the folder that the command names"
                )
                save.on_click(lambda _: self._try(self._save))

    async def _on_camera(self, camera: viser.CameraHandle) -> None:
        self._moved(camera)

    def _moved(self, camera: viser.CameraHandle) -> None:
        self.viewer.move(self.client.client_id, _pose(camera))

    def _choose(self, name: str, value: Any) -> None:
        if name == "cap" and isinstance(value, (int, float)) and value >= self._cap.max:
            value = None
        self.viewer.choose(self.client.client_id, name, value)

    def _do_reload(self) -> None:
        assert self._reload is not None
        self.set_status(self._reload())

    def _show_cameras(self, shown: bool) -> None:
        """Show or hide the cameras; they are made when they are first shown."""
        if shown and not self._frusta:
            for kind, items, colour in (("train", self.known.train, _TRAIN), ("test", self.known.test, _TEST)):
                self._frusta += [
                    self._frustum(f"/cameras/{kind}/{number}", item, colour) for number, item in enumerate(items)
                ]
        for frustum in self._frusta:
            frustum.visible = bool(shown)

    def _frustum(self, name: str, item: NamedCamera, colour: tuple[int, int, int]) -> viser.CameraFrustumHandle:
        camera = item.camera
        aspect = (camera.width / camera.fx) / (camera.height / camera.fy)
        frustum = self.client.scene.add_camera_frustum(
            name,
            vertical_fov(camera),
            aspect,
            scale=self.known.size,
            thickness=1.5,
            thickness_units="screen",
            color=colour,
            wxyz=_wxyz(camera),
            position=camera.position,
        )
        frustum.on_click(lambda _: self._jump(camera))
        return frustum

    def _jump(self, camera: Camera | None) -> None:
        """Move to a camera, with its whole image in the window."""
        if camera is None:
            return
        eye = self.client.camera
        aspect = eye.image_width / max(eye.image_height, 1)
        try:
            with self.client.atomic():
                eye.wxyz = _wxyz(camera)
                eye.position = camera.position
                eye.fov = vertical_fov(camera, aspect if math.isfinite(aspect) and aspect > 0 else None)
        except ValueError as error:  # the browser has reported an unusable camera
            self.set_status(f"cannot go there: {error}")
        self.client.flush()

    def _add_key(self) -> None:
        camera = camera_of(_pose(self.client.camera), MAX_SIZE)
        if camera is not None:
            self._recording.add(camera)

    def _pace(self, seconds: Any) -> None:
        if math.isfinite(seconds):
            self._recording.seconds = min(max(float(seconds), 0.1), MAX_SECONDS)

    def _play(self) -> None:
        self._stop()
        path, self._playing = self._recording.path(), threading.Event()
        threading.Thread(target=self._walk, args=(path, self._playing), daemon=True).start()

    def _walk(self, path: CameraPath, stop: threading.Event) -> None:
        start = time.monotonic()
        while not stop.wait(1.0 / path.fps):
            frame = int((time.monotonic() - start) * path.fps)
            self._jump(path.cameras[min(frame, len(path.cameras) - 1)])
            if frame >= len(path.cameras) - 1:
                return

    def _stop(self) -> None:
        if self._playing is not None:
            self._playing.set()

    def _download(self) -> None:
        self.client.send_file_download(FILE_NAME, self._recording.text().encode())

    def _save(self) -> None:
        assert self._folder is not None
        self.set_status(f"saved as {self._recording.save(self._folder).name}")

    def _try(self, action: Callable[[], object]) -> None:
        """Run an action and show the message of an error that a user can fix."""
        try:
            action()
        except ClsplatError as error:
            self.set_status(str(error))


def plain(text: str) -> str:
    """Escape a text, so that the panel shows it without markup."""
    return "".join("\\" + char if char in r"\`*_{}[]()<>#+-!|~$&" else char for char in text.replace("\n", " "))


def _pose(camera: viser.CameraHandle) -> Pose:
    return Pose(camera.wxyz.tolist(), camera.position.tolist(), camera.fov, camera.image_width, camera.image_height)


def _wxyz(camera: Camera) -> Any:
    """Return the camera-to-world rotation as viser expects it."""
    return transforms.SO3.from_matrix(camera.rotation.T).wxyz


def _step(n: int) -> int:
    """Return the step of a slider from 0 to n with about two hundred steps."""
    return max(n // 200, 1)
