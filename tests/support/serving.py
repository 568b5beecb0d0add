"""A viewer's server with the thread that makes its pictures."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

pytest.importorskip("viser", reason="viser is not installed (pip install clsplat[view])")

from clsplat.viewer.server import Server
from clsplat.viewer.viewer import Viewer


@contextmanager
def serving(viewer: Viewer, server: Server) -> Iterator[Server]:
    """Make pictures in a thread inside the block, then close both."""
    worker = threading.Thread(target=viewer.run)
    worker.start()
    try:
        yield server
    finally:
        viewer.close()
        server.close()
        worker.join()
