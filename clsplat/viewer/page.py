"""The panel of one browser: settings, cameras to jump to, and the parts for paths, boxes and help."""

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
from ..errors import ClsplatError
from ..files.images import encode_render
from ..splats.fields import DoubleArray
from .camera import Pose, camera_of
from .crop import CropBox
from .crop_panel import CropPanel
from .initial_view import UP, SceneCameras, vertical_fov
from .legend import legend
from .measure_panel import MeasurePanel
from .page_download import PageDownload
from .path_panel import PathPanel
from .settings import DEFAULT_SIZE, MAX_SIZE, MIN_SIZE, Settings
from .status_line import StatusLine, plain
from .viewer import Viewer, ViewerImage

QUALITY, MOVING_QUALITY = 95, 80  # JPEG quality of still and of moving frames
_STATUS_INTERVAL = 0.5  # seconds between changes of the status line while moving
_TRAIN, _TEST = (110, 170, 255), (255, 160, 60)
_NO_CAMERA = "–"
_FOVS, _FOV_STEP = (5.0, 150.0), 0.5  # degrees
_MODES = {"colour": "Colour", "depth": "Depth", "alpha": "Alpha", "splats": "Splats a pixel", "skew": "Skew magnitude"}

# The mouse and the keys are viser's.
HELP = """
| | |
|---|---|
| **drag** | turn about the point in the middle |
| **right drag** | move sideways |
| **wheel** | move nearer or farther |
| **arrows** | turn |
| **W S** | forwards, backwards |
| **A D** | left, right |
| **E Q** | up, down |
| **F11** | full screen (the browser's key) |

On a touch screen one finger turns, and two fingers move. Click into the picture before you use the keys. A click on a
drawn camera jumps to it.
"""


class Page:
    """The panel of one browser.

    Parameters
    ----------
    reload : reads the model file again and returns a status text, or None if there is no file.
    folder : folder for saved paths and models, or None if they can only be downloaded.
    name : of the model, for the files of its pictures.
    up : upward direction of the scene.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        viewer: Viewer,
        known: SceneCameras,
        reload: Callable[[], str] | None = None,
        folder: Path | None = None,
        name: str = "view",
        up: DoubleArray = UP,
    ) -> None:
        self.client, self.viewer, self.known = client, viewer, known
        self._reload, self._name = reload, name
        self._cameras = known.by_label
        self._pictures = 0  # sent to this browser
        self._rates: list[float] = []
        self._status_time = 0.0
        self._frusta: list[viser.CameraFrustumHandle] = []
        # The browser gets the panel as a whole, after `join`: what it sends before that would be lost.
        with client.atomic():
            line = client.gui.add_markdown("")
            self._status = StatusLine(lambda text: setattr(line, "content", text))
            self._add_settings()
            if known.by_label:
                self._add_cameras()
            self._path = PathPanel(client, self._here, self._jump, self._try, self.set_status, folder)
            self._crop = CropPanel(
                client, lambda: viewer.source.splats, up, self._choose_box, self._try, self.set_status, folder
            )
            self._measure = MeasurePanel(client, lambda: viewer.source, self._settings, self.set_status)
            with client.gui.add_folder("Help", expand_by_default=False):
                client.gui.add_markdown(HELP)
            viewer.join(client.client_id, self.send)
        client.camera.on_update(self._on_camera)
        self._moved(client.camera)

    def close(self) -> None:
        """Remove the client after the browser has gone."""
        self.viewer.leave(self.client.client_id)
        self._path.stop()
        self._status.close()

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
            self._show_legend(frame)
            height, width = frame.picture.shape[:2]
            rate = "" if frame.still else f", {len(self._rates)} a second"
            size = f"{self.viewer.source.n_splats} splats, {width} × {height} px"
            if frame.message:
                self._status.say(frame.message)
            else:
                self._status.describe(f"{size}, {1e3 * frame.seconds:.0f} ms{rate}")

    def set_status(self, text: str) -> None:
        """Show a message in the status line at the top of the panel."""
        self._status.say(text)

    def model_changed(self) -> None:
        """Adapt the sliders to the new model. A message about the previous model need not stay."""
        self._status.expire()
        n = self.viewer.source.n_splats
        everything = self._cap.value >= self._cap.max
        self._cap.max, self._cap.step, self._cap.visible = max(n, 1), _step(n), self.viewer.source.partial
        if everything or self._cap.value > n:
            self._cap.value = max(n, 1)
        degree = max(self.viewer.source.sh_degree, 1)
        all_bands = self._degree.value >= self._degree.max
        self._degree.max, self._degree.visible = degree, self.viewer.source.sh_degree > 0
        if all_bands or self._degree.value > degree:
            self._degree.value = degree
        self._crop.model_changed()
        self._measure.model_changed()

    def _add_settings(self) -> None:
        gui, viewer, source = self.client.gui, self.viewer, self.viewer.source
        chosen = self._settings()
        with gui.add_folder("View"):
            labels = {label: mode for mode, label in _MODES.items() if mode in source.modes}
            mode = gui.add_dropdown("Show", tuple(labels), hint="The property of the splats that is shown")
            mode.on_update(lambda _: self._choose("mode", labels.get(mode.value)))
            self._legend = gui.add_html("", visible=False)
            if source.sides is not None:
                gui.add_markdown(plain(" | ".join(source.sides)))
                divider = gui.add_slider("Divider", 0.0, 1.0, 0.005, chosen.divider, hint="Between the two models")
                divider.on_update(lambda _: self._choose("divider", divider.value))
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
            self._fov: Any = gui.add_slider(
                "Field of view", *_FOVS, _FOV_STEP, 60.0, hint="Vertical angle of the camera in degrees"
            )
            self._fov.on_update(lambda _: self._set_fov(self._fov.value))
            self._degree: Any = gui.add_slider(
                "SH degree",
                0,
                max(source.sh_degree, 1),
                1,
                max(source.sh_degree, 1),
                hint="Bands of view-dependent colour",
                visible=source.sh_degree > 0,
            )
            self._degree.on_update(lambda _: self._choose("sh_degree", self._degree.value))
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
            longest = gui.add_number(
                "Picture size", DEFAULT_SIZE, min=MIN_SIZE, max=MAX_SIZE, step=1, hint="Longest side in pixels"
            )
            save = gui.add_button(
                "Download picture", icon=viser.Icon.CAMERA, hint="This view as PNG, with the bytes of clsplat render"
            )
            save.on_click(lambda _: self._order_picture(longest.value))
            PageDownload(
                self.client,
                lambda: viewer.source.splats,
                self.known,
                self._name,
                lambda: self._settings().background,
                self.set_status,
            )
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

    async def _on_camera(self, camera: viser.CameraHandle) -> None:
        self._moved(camera)

    def _moved(self, camera: viser.CameraHandle) -> None:
        self.viewer.move(self.client.client_id, _pose(camera))
        degrees = math.degrees(camera.fov) if math.isfinite(camera.fov) else 0.0
        if _FOVS[0] <= degrees <= _FOVS[1] and abs(degrees - self._fov.value) > 0.5 * _FOV_STEP:
            self._fov.value = _FOV_STEP * round(degrees / _FOV_STEP)

    def _set_fov(self, degrees: Any) -> None:
        """Change the angle of the camera. The slider is rounded: it does not change an angle that it shows."""
        eye = self.client.camera
        if math.isfinite(degrees) and abs(math.degrees(eye.fov) - degrees) > 0.5 * _FOV_STEP:
            eye.fov = math.radians(min(max(degrees, _FOVS[0]), _FOVS[1]))
            self._moved(eye)

    def _here(self) -> Camera | None:
        return camera_of(_pose(self.client.camera), MAX_SIZE)

    def _settings(self) -> Settings:
        return self.viewer.settings_of(self.client.client_id)

    def _choose_box(self, box: CropBox | None) -> None:
        self.viewer.choose(self.client.client_id, "crop", box)

    def _show_legend(self, frame: ViewerImage) -> None:
        """Show the colour bar of a frame."""
        bar = "" if frame.message else legend(self._settings().mode, frame.near_far)
        if bar != self._legend.content:
            self._legend.content, self._legend.visible = bar, bool(bar)

    def _order_picture(self, size: Any) -> None:
        """Send the view as a PNG file, as soon as it is rendered."""
        if isinstance(size, (int, float)) and math.isfinite(size):
            longest = round(min(max(size, MIN_SIZE), MAX_SIZE))
            self.viewer.order_picture(self.client.client_id, longest, self._send_picture)

    def _send_picture(self, frame: ViewerImage) -> None:
        if frame.message:
            self.set_status(frame.message)
        else:  # packing a large picture takes longer than a frame
            threading.Thread(target=self._pack, args=(frame,), daemon=True).start()

    def _pack(self, frame: ViewerImage) -> None:
        self._pictures += 1
        name = f"{self._name}_{self._pictures:03}.png"
        self.client.send_file_download(name, encode_render(frame.picture), save_immediately=True)

    def _choose(self, name: str, value: Any) -> None:
        slider = {"cap": self._cap, "sh_degree": self._degree}.get(name)
        if slider is not None and isinstance(value, (int, float)) and value >= slider.max:
            value = None  # all of them, also of a later model that has more
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

    def _try(self, action: Callable[[], object]) -> None:
        """Run an action and show the message of an error that a user can fix."""
        try:
            action()
        except ClsplatError as error:
            self.set_status(str(error))


def _pose(camera: viser.CameraHandle) -> Pose:
    return Pose(camera.wxyz.tolist(), camera.position.tolist(), camera.fov, camera.image_width, camera.image_height)


def _wxyz(camera: Camera) -> Any:
    """Return the camera-to-world rotation as viser expects it."""
    return transforms.SO3.from_matrix(camera.rotation.T).wxyz


def _step(n: int) -> int:
    """Return the step of a slider from 0 to n with about two hundred steps."""
    return max(n // 200, 1)
