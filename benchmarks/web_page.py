"""The web pages of models: bytes, PSNR against clsplat's renders, seconds to open, and pictures a second.

    python benchmarks/web_page.py MODEL MODEL ...     # model folders; needs Chromium and the extra test-view
    python benchmarks/web_page.py --table [--write]   # print the stored rows; write the table into docs/web-page.md
    python benchmarks/web_page.py --smoke --out FILE

Chromium draws without a graphics card (SwiftShader), at 640x480 px. The PSNR is that of the first cameras of a model,
at the size of their photos. "opened" is the time until the first whole picture. "whole" is the time of a picture at
full size, and "a second" counts the pictures of the tour, whose size the page adapts.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from clsplat.evaluation.metrics import psnr
from clsplat.models.convert import PageOptions, conversion_cost, convert_model
from clsplat.models.model import LoadedModel, load_model
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.formats.page_payload import PRECISIONS

sys.path.extend(common.TEST_HELPERS)

KEY = ("model", "splats", "precision", "commit")
CAMERAS, PICTURES = 6, 7
TOUR_SECONDS = 6
WINDOW = {"width": 640, "height": 480}
MARKS = ("<!-- table of web_page.py -->", "<!-- end of the table of web_page.py -->")
PAGE = common.ROOT / "docs" / "web-page.md"
_DRAW = """() => { const gl = page.renderer.gl, read = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE,
    new Uint8Array(4)); read(); const start = performance.now(); page.draw(1, 0); read();
    return performance.now() - start; }"""
_COUNT = """() => { window.pictures = 0; const draw = page.draw.bind(page);
    page.draw = (...rest) => { ++window.pictures; draw(...rest); }; }"""


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "web_page.jsonl")
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--write", action="store_true", help=f"write the table into {PAGE.name}")
    args = parser.parse_args()
    runs = common.Runs(args.out, KEY)
    if not args.table:
        from viewer_browser import chromium

        with chromium() as browser, tempfile.TemporaryDirectory() as scratch:
            models = [smoke_model(Path(scratch))] if args.smoke else args.models
            for model in models:
                measure(browser, load_model(model), args, runs, Path(scratch))
    text = table(runs.rows)
    print(text)
    if args.write:
        common.write_between(PAGE, *MARKS, text)


def measure(browser: Any, model: LoadedModel, args: argparse.Namespace, runs: common.Runs, scratch: Path) -> None:
    """Measure the pages of a model that are not among the rows yet."""
    renderer = Renderer(args.device)
    for precision in PRECISIONS:
        case = {
            "model": model.path.name,
            "shape": model.splats.shape,
            "splats": len(model.splats),
            "precision": precision,
            **common.environment(renderer.device, schedule_for(renderer.device)),
        }
        if case in runs:
            continue
        path = scratch / f"{precision}.html"
        converted = convert_model(model, path, page=PageOptions(precision), overwrite=True)
        cost = conversion_cost(converted, device=args.device)
        assert cost is not None
        page, opened = open_page(browser, path, WINDOW)
        whole = statistics.median(page.evaluate(_DRAW) for _ in range(PICTURES))
        page.keyboard.press("t")
        page.wait_for_timeout(2000)  # the size of the pictures settles
        page.evaluate(_COUNT)
        page.wait_for_timeout(1 if args.smoke else 1000 * TOUR_SECONDS)
        rate, share = page.evaluate("[window.pictures, page.share]")
        page.close()
        runs.add(
            case
            | {
                "bytes": path.stat().st_size,
                "rounding_psnr": round(cost.mean, 2),
                "psnr": round(in_browser(browser, path, model, renderer), 2),
                "opened_s": round(opened, 2),
                "whole_ms": round(whole),
                "pictures": round(rate / TOUR_SECONDS, 1),
                "share": round(share, 2),
            }
        )


def open_page(browser: Any, path: Path, window: dict[str, int]) -> tuple[Any, float]:
    """Open a page, and return it with the seconds until its first whole picture."""
    page = browser.new_context(viewport=window).new_page()
    start = time.perf_counter()
    page.goto(path.as_uri())
    page.wait_for_function("page.settled", timeout=120_000)
    return page, time.perf_counter() - start


def in_browser(browser: Any, path: Path, model: LoadedModel, renderer: Renderer) -> float:
    """Return the mean PSNR of the page's pictures against the model's renders, at the first cameras."""
    from viewer_browser import canvas_picture

    values = []
    for number, named in enumerate(model.read_cameras()[:CAMERAS]):
        camera = named.camera
        page, _ = open_page(browser, path, {"width": camera.width, "height": camera.height})
        page.evaluate(f"page.jump({number})")
        shown = canvas_picture(page)
        page.context.close()
        expected = renderer.render(model.splats, camera, model.background).color
        values.append(psnr(shown, np.clip(expected, 0, 1).astype(np.float32)))
    return float(np.mean(values))


def smoke_model(folder: Path) -> Path:
    """Train a model of a few splats on the small demo scene, and return its folder."""
    from clsplat.scenes.demo.scene import write_capture
    from clsplat.scenes.scene import load_scene
    from clsplat.training.config import TrainConfig
    from clsplat.training.run import train

    scene = load_scene(write_capture(folder / "scene", 48, 36, 6))
    train(scene, TrainConfig(shape="skew-normal", iterations=2, cap_max=60), output=folder / "smoke")
    return folder / "smoke"


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table."""
    head = ["model", "splats", "precision", "MB", "bytes a splat", "rounding, dB", "in Chromium, dB"]
    head += ["opened, s", "whole, ms", "a second", "at a size of", "commit"]
    cells = (
        [
            f"`{row['model']}`",
            f"{row['splats']}",
            row["precision"],
            f"{row['bytes'] / 1e6:.2f}",
            f"{row['bytes'] / row['splats']:.0f}",
            f"{row['rounding_psnr']:.1f}",
            f"{row['psnr']:.1f}",
            f"{row['opened_s']:.1f}",
            f"{row['whole_ms']}",
            f"{row['pictures']:.0f}",
            f"{100 * row['share']:.0f} %",
            row["commit"],
        ]
        for row in rows
    )
    return common.table(head, cells, set(head) - {"model", "precision", "commit"})


if __name__ == "__main__":
    main()
