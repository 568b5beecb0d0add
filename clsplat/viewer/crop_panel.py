"""The part of the panel that hides what is outside of a box, and writes what is inside."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from ..errors import InputError
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .crop import CropBox, box_around, unit_edges
from .numbered import save_numbered

FILE_NAME = "cropped.ply"
_COLOUR = (255, 200, 60)
_DIGITS = 3  # of a size, after its first
_HANDLE = 0.25  # size of a handle as a share of the box


class CropPanel:
    """A box with two handles: one at its centre moves and turns it, one at a corner changes its size.

    Parameters
    ----------
    model : returns the splats, or None if they cannot be cropped, as during a run.
    up : upward direction of the scene. choose : takes the box, None for no box.
    attempt : runs an action and shows its error. say : shows a text.
    folder : for saved models, or None if they can only be downloaded.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        model: Callable[[], Splats | None],
        up: DoubleArray,
        choose: Callable[[CropBox | None], None],
        attempt: Callable[[Callable[[], object]], None],
        say: Callable[[str], None],
        folder: Path | None,
    ) -> None:
        self._client, self._model, self._up, self._choose = client, model, up, choose
        self._say, self._folder = say, folder
        self._lock = threading.RLock()  # messages of a browser come in several threads

        def serially(action: Callable[[], object]) -> Callable[[object], None]:
            def run(_: object) -> None:
                with self._lock:
                    attempt(action)

            return run

        self._serially = serially
        self._box: CropBox | None = None
        self._handles: tuple[viser.TransformControlsHandle, viser.TransformControlsHandle] | None = None
        self._lines: viser.LineSegmentsHandle | None = None
        gui = client.gui
        self._group = gui.add_folder("Crop box", expand_by_default=False, visible=model() is not None)
        with self._group:
            self._on: Any = gui.add_checkbox(
                "Crop", False, hint="Hide splats whose centre is outside. Drag the handles, or type the size"
            )
            self._on.on_update(serially(self._switch))
            self._count = gui.add_markdown("")
            self._size: Any = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(0.0, 0.0, 0.0), step=0.01)
            self._size.on_update(serially(self._resize))
            gui.add_button("Fit to the model").on_click(serially(self._fit))
            download = gui.add_button("Download PLY", icon=viser.Icon.DOWNLOAD, hint="The splats in the box")
            download.on_click(serially(self._download))
            if folder is not None:
                save = gui.add_button(
                    "Save PLY", icon=viser.Icon.DEVICE_FLOPPY, hint="Into the folder that the command names"
                )
                save.on_click(serially(self._save))

    def model_changed(self) -> None:
        """Show this part of the panel once there is a model."""
        self._group.visible = self._model() is not None
        self._say_count()

    def _switch(self) -> None:
        if not self._on.value:
            self._show(False)
            self._choose(None)
        elif self._box is None:
            self._fit()
        else:
            self._set(self._box)

    def _fit(self) -> None:
        self._set(box_around(self._splats().mean, self._up))

    def _resize(self) -> None:
        if self._box is not None and not np.allclose(self._size.value, self._box.size, rtol=1e-6):
            self._set(CropBox.of(self._box.centre, self._box.wxyz, self._size.value))

    def _dragged(self, corner: bool) -> None:
        assert self._handles is not None
        assert self._box is not None
        centre, handle = self._handles
        size = np.maximum(2.0 * np.abs(handle.position), 1e-6) if corner else self._box.size
        self._set(CropBox.of(centre.position, centre.wxyz, size), moved=centre if not corner else handle)

    def _set(self, box: CropBox, moved: viser.TransformControlsHandle | None = None) -> None:
        """Take a box and draw it. A handle that the user holds is not moved."""
        self._box = box
        with self._client.atomic():
            if not self._on.value:
                self._on.value = True
            digits = _DIGITS - math.floor(math.log10(max(box.size)))
            if self._size.step != 10.0**-digits:  # a small model needs more decimals
                self._size.precision, self._size.step = max(digits, 0), 10.0**-digits
            if not np.allclose(self._size.value, box.size, rtol=1e-6):
                self._size.value = box.size
            self._draw(box, moved)
            self._show(True)
        self._choose(box)
        self._say_count()

    def _draw(self, box: CropBox, moved: viser.TransformControlsHandle | None) -> None:
        scene, scale = self._client.scene, _HANDLE * float(np.mean(box.size))
        corner = 0.5 * np.asarray(box.size)
        if self._handles is None or self._lines is None:
            # The corner and the lines are in the frame of the centre, so that they follow it.
            centre = scene.add_transform_controls("/crop", scale=scale, depth_test=False)
            handle = scene.add_transform_controls("/crop/corner", disable_rotations=True, depth_test=False)
            self._handles = centre, handle
            self._lines = scene.add_line_segments(
                "/crop/edges", unit_edges(), _COLOUR, thickness=2.0, thickness_units="screen"
            )
            centre.on_update(self._serially(lambda: self._dragged(False)))
            handle.on_update(self._serially(lambda: self._dragged(True)))
        centre, handle = self._handles
        if moved is not centre:
            centre.position, centre.wxyz = box.centre, box.wxyz
        if moved is not handle:
            handle.position = corner
        if moved is None:
            centre.scale, handle.scale = scale, 0.6 * scale
        self._lines.scale = box.size

    def _show(self, shown: bool) -> None:
        for item in (*(self._handles or ()), self._lines):
            if item is not None:
                item.visible = shown

    def _say_count(self) -> None:
        splats = self._model()
        if splats is not None and self._box is not None:
            self._count.content = f"{int(self._box.contains(splats.mean).sum())} of {len(splats)} splats are inside"

    def _splats(self) -> Splats:
        splats = self._model()
        if splats is None:
            raise InputError("box: a run cannot be cropped before it has finished")
        return splats

    def _inside(self) -> Splats:
        """Return the splats in the box. Raises InputError if there is no box or nothing in it."""
        splats = self._splats()
        if self._box is None or not self._on.value:
            raise InputError("box: set Crop first")
        kept = splats.select(self._box.contains(splats.mean))
        if not len(kept):
            raise InputError("box: contains no splats; move it or make it larger")
        return kept

    def _download(self) -> None:
        splats = self._inside()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / FILE_NAME
            splats.save(path)
            content = path.read_bytes()
        self._client.send_file_download(FILE_NAME, content, save_immediately=True)
        self._say(f"{FILE_NAME}: {len(splats)} splats")

    def _save(self) -> None:
        assert self._folder is not None
        splats: Any = self._inside()
        path = save_numbered(self._folder, "cropped", ".ply", splats.save)
        self._say(f"saved as {path.name}: {len(splats)} splats")
