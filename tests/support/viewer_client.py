"""Client of a viewer that replaces a browser: it sends its camera and receives pictures and the panel."""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from numpy.typing import NDArray
from PIL import Image
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol


class Client:
    """One connection.

    Parameters
    ----------
    origin, host : the headers of the page that connects; None sends no Origin and the usual Host.
    path : of the address, with its query.

    Attributes
    ----------
    panel : properties of the panel's elements, by uuid.
    pictures : JPEG bytes received so far.
    """

    def __init__(self, port: int, origin: str | None = None, host: str | None = None, path: str = "/") -> None:
        self.panel: dict[str, dict[str, Any]] = {}
        self.pictures: list[bytes] = []
        self.received: list[dict[str, Any]] = []
        # The library takes the Host header from the address, and the connection from the socket.
        self._socket = connect(
            f"ws://{host or f'127.0.0.1:{port}'}{path}",
            sock=socket.create_connection(("127.0.0.1", port)),
            origin=None if origin is None else Origin(origin),
            proxy=None,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
            compression=None,
        )

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection as a browser does."""
        self._socket.close()

    def vanish(self) -> None:
        """Cut the connection without closing it."""
        self._socket.socket.close()

    def look(
        self,
        position: Sequence[float] = (0, 0, -3),
        wxyz: Sequence[float] = (1, 0, 0, 0),
        fov: float = 1.0,
        width: int = 96,
        height: int = 64,
    ) -> None:
        """Send a camera."""
        self.send(
            {
                "type": "ViewerCameraMessage",
                "wxyz": [float(part) for part in wxyz],
                "position": [float(part) for part in position],
                "fov": float(fov),
                "near": 0.01,
                "far": 1000.0,
                "image_height": height,
                "image_width": width,
                "look_at": [0, 0, 0],
                "up_direction": [0, -1, 0],
            }
        )

    def set(self, label: str, value: Any) -> None:
        """Change an element of the panel. For a button, press it."""
        self.send({"type": "GuiUpdateMessage", "uuid": self.uuid(label), "updates": {"value": value}})

    def uuid(self, label: str) -> str:
        """Return the uuid of the element with this label. Wait until it exists."""
        end = time.monotonic() + 10
        while time.monotonic() < end:
            for uuid, props in self.panel.items():
                if props.get("label") == label:
                    return uuid
            self.receive(0.1)
        raise AssertionError(f"no {label!r} in the panel")

    def texts(self) -> list[str]:
        """Return the texts of the panel."""
        return [props["_markdown"] for props in self.panel.values() if "_markdown" in props]

    def send(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def send_raw(self, data: bytes) -> None:
        self._socket.send(data)

    def receive(self, timeout: float) -> bool:
        """Receive one bundle of messages. Return False if none arrives in time."""
        try:
            data = self._socket.recv(timeout)
        except TimeoutError:
            return False
        assert isinstance(data, bytes)
        size = int.from_bytes(data[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(
            data[16 : 16 + size], max_output_size=int.from_bytes(data[:8], "little")
        )
        for message in msgspec.msgpack.decode(inner)["messages"]:
            kind = message["type"]
            self.received.append(message)
            if kind == "BackgroundImageMessage" and message["rgb_data"]:
                self.pictures.append(message["rgb_data"])
            elif kind.startswith("Gui") and "props" in message:
                self.panel[message["uuid"]] = dict(message["props"])
            elif kind == "GuiUpdateMessage" and message["uuid"] in self.panel:
                self.panel[message["uuid"]] |= message["updates"]
        return True

    def drain(self, seconds: float) -> None:
        """Receive until no message arrives for this time."""
        while self.receive(seconds):
            pass

    def picture(self, timeout: float = 10.0) -> NDArray[np.uint8]:
        """Return the next picture, (H, W, 3)."""
        before, end = len(self.pictures), time.monotonic() + timeout
        while len(self.pictures) == before:
            if time.monotonic() > end:
                raise AssertionError("no picture came")
            self.receive(0.1)
        return decoded(self.pictures[-1])

    def last(self) -> NDArray[np.uint8]:
        """Return the last received picture, (H, W, 3)."""
        return decoded(self.pictures[-1])

    def still(self, shape: tuple[int, int] = (64, 96), timeout: float = 10.0) -> NDArray[np.uint8]:
        """Return the next picture of full size (height, width)."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            shown = self.picture(max(end - time.monotonic(), 0.1))
            if shown.shape[:2] == shape:
                return shown
        raise AssertionError("no picture of full size came")

    def until(self, text: str, timeout: float = 10.0) -> None:
        """Wait until a line of the panel contains this text."""
        end = time.monotonic() + timeout
        while not any(text in line for line in self.texts()):
            if time.monotonic() > end:
                raise AssertionError(f"{text!r} is in none of {self.texts()}")
            self.receive(0.1)


def decoded(picture: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a JPEG."""
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
