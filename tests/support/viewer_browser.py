"""Headless Chromium for the tests of the viewer, and a wall of splats to look at."""

from __future__ import annotations

import base64
import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from clsplat.splats.harmonics import SH_C0
from clsplat.splats.splats import Splats

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# WebGL without a graphics card; root may not use the sandbox.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def chromium(*flags: str) -> Iterator[Browser]:
    """Run a browser with more command-line flags."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, *flags])
        yield browser
        browser.close()


def canvas_picture(page: Page) -> NDArray[np.float32]:
    """Return what the canvas of a web page shows as soon as its view is at rest, (H, W, 3), 0 to 1."""
    page.wait_for_function("page.settled", timeout=120_000)
    return shown(page)


def shown(page: Page) -> NDArray[np.float32]:
    """Return what the canvas of a web page shows now, (H, W, 3), 0 to 1."""
    data = page.evaluate("page.canvas.toDataURL('image/png')").split(",")[1]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
    return picture.astype(np.float32) / 255


def wall() -> Splats:
    """Return a wall of splats four units ahead: red on the left, green on the right, brighter downwards."""
    y, x = np.mgrid[-1.5:1.5:25j, -2.0:2.0:33j]
    n = x.size
    colour = np.stack([x < 0, x >= 0, np.zeros_like(x)], axis=-1).reshape(n, 3) * (0.6 + 0.25 * y.reshape(n, 1))
    return Splats(
        "gaussian",
        {
            "mean": np.stack([x, y, np.full_like(x, 4.0)], axis=-1).reshape(n, 3).astype(np.float32),
            "quat": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            "log_scale": np.full((n, 3), np.log(0.1), np.float32),
            "opacity_logit": np.full(n, 6.0, np.float32),
            "sh": ((colour - 0.5) / SH_C0)[:, None].astype(np.float32),
        },
    )
