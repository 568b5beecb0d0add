"""The part of the panel that records a camera path."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import viser

from ..cameras.camera import Camera
from ..cameras.path import CameraPath
from .recording import FILE_NAME, MAX_SECONDS, Recording


class PathPanel:
    """Keys of a path, its preview and its files.

    Parameters
    ----------
    here : returns the client's camera. jump : moves it. attempt : runs an action and shows its error.
    say : shows a text. folder : for saved paths, or None if paths can only be downloaded.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        here: Callable[[], Camera | None],
        jump: Callable[[Camera | None], None],
        attempt: Callable[[Callable[[], object]], None],
        say: Callable[[str], None],
        folder: Path | None,
    ) -> None:
        self._client, self._here, self._jump, self._folder, self._say = client, here, jump, folder, say
        self._recording = Recording()
        self._playing: threading.Event | None = None
        gui, recording = client.gui, self._recording
        with gui.add_folder("Camera path", expand_by_default=False):
            keys = gui.add_markdown("No keys")

            def changed(done: Callable[[], object]) -> Callable[[object], None]:
                def on_click(_: object) -> None:
                    attempt(done)
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
            gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY).on_click(lambda _: attempt(self._play))
            gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP).on_click(lambda _: self.stop())
            download = gui.add_button(
                "Download", icon=viser.Icon.DOWNLOAD, hint="As camera_path.json, for clsplat render --path"
            )
            download.on_click(lambda _: attempt(self._download))
            if folder is not None:
                save = gui.add_button(
                    "Save", icon=viser.Icon.DEVICE_FLOPPY, hint="Into the folder that the command names"
                )
                save.on_click(lambda _: attempt(self._save))

    def stop(self) -> None:
        """End the preview."""
        if self._playing is not None:
            self._playing.set()

    def _add_key(self) -> None:
        camera = self._here()
        if camera is not None:
            self._recording.add(camera)

    def _pace(self, seconds: Any) -> None:
        if math.isfinite(seconds):
            self._recording.seconds = min(max(float(seconds), 0.1), MAX_SECONDS)

    def _play(self) -> None:
        self.stop()
        path, self._playing = self._recording.path(), threading.Event()
        threading.Thread(target=self._walk, args=(path, self._playing), daemon=True).start()

    def _walk(self, path: CameraPath, stop: threading.Event) -> None:
        start = time.monotonic()
        while not stop.wait(1.0 / path.fps):
            frame = int((time.monotonic() - start) * path.fps)
            self._jump(path.cameras[min(frame, len(path.cameras) - 1)])
            if frame >= len(path.cameras) - 1:
                return

    def _download(self) -> None:
        self._client.send_file_download(FILE_NAME, self._recording.text().encode(), save_immediately=True)

    def _save(self) -> None:
        assert self._folder is not None
        self._say(f"saved as {self._recording.save(self._folder).name}")
