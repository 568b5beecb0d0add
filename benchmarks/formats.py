"""Formats of files: bytes, PSNR of their pictures against the model's, and seconds to write and to read.

    python benchmarks/formats.py MODEL MODEL ...        # model folders
    python benchmarks/formats.py --random 20000 1000000 # bytes and seconds of random skew-normals
    python benchmarks/formats.py --table [--write]      # print the stored rows; write table and chart into docs/
    python benchmarks/formats.py --smoke --out FILE

"dB" is the PSNR of the written file's pictures against those of the model, at the first cameras. Formats that hold
Gaussians only get the nearest Gaussian of each splat. "rounding" is then the PSNR against the pictures of these
Gaussians. Seconds are medians of three writings and readings, or of one of many splats. They are without the search for
the nearest Gaussians.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import common
import numpy as np

from clsplat.cameras.camera import Camera
from clsplat.evaluation import chart_style
from clsplat.evaluation.evaluate import MAX_PSNR
from clsplat.evaluation.metrics import psnr
from clsplat.models.model import LoadedModel, load_model
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.approximate import nearest_gaussians
from clsplat.splats.fields import public_shape
from clsplat.splats.formats.any_file import WRITTEN
from clsplat.splats.shapes import GAUSSIAN, SKEW_NORMAL
from clsplat.splats.splats import Splats
from clsplat.webpage.page import PageContent, write_web_page

sys.path.extend(common.TEST_HELPERS)

KEY = ("model", "splats", "format", "commit")
CAMERAS = 8
REPEATS, MANY = 3, 200_000  # readings and writings; above this number of splats there is one
DOCS = common.ROOT / "docs"
PAGE, CHART = DOCS / "formats.md", DOCS / "images" / "formats"
ZSTD = "compression" if sys.version_info >= (3, 14) else "zstandard"
_SKEWED, _GAUSSIAN = "#0072b2", "#d55e00"  # files with the kernel of the model, and with the nearest Gaussians
_TICKS = (25, 50, 100, 200)
MARKS = ("<!-- table of formats.py -->", "<!-- end of the table of formats.py -->")
TIMES = ("<!-- times of formats.py -->", "<!-- end of the times of formats.py -->")


@dataclass(frozen=True)
class Format:
    """A format, or a format with an option.

    name : of the rows. ending : of the file. write : writes splats. library : what it needs besides clsplat.
    gaussians : whether the file gets the nearest Gaussians, although it can hold the skew.
    """

    name: str
    ending: str
    write: Callable[[Path, Splats], None]
    library: str = "numpy"
    gaussians: bool = False


def _save(**options: Any) -> Callable[[Path, Splats], None]:
    return lambda path, splats: splats.save(path, **options)


def _page(precision: str) -> Callable[[Path, Splats], None]:
    return lambda path, splats: write_web_page(path, splats, PageContent("model"), precision)


FORMATS = (
    Format(".ply", ".ply", _save()),
    Format(".ply, compact", ".ply", _save(compact=True)),
    Format(".glb", ".glb", _save()),
    Format(".usdc", ".usdc", _save(), "pxr"),
    Format(".html, full", ".html", _page("full")),
    Format(".html", ".html", _page("compact")),
    Format(".spz, version 3", ".spz", _save(spz_version=3)),
    Format(".spz, version 4", ".spz", _save(spz_version=4), ZSTD),
    Format(".sog", ".sog", _save()),
    Format(".sog, Gaussians", ".sog", _save(), gaussians=True),
    Format(".splat", ".splat", _save()),
)


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "formats.jsonl")
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--random", nargs="*", type=int, default=[], metavar="N", help="numbers of random splats")
    parser.add_argument("--write", action="store_true", help=f"write tables and chart into {DOCS.name}/")
    args = parser.parse_args()
    runs = common.Runs(args.out, KEY)
    if not args.table:
        with tempfile.TemporaryDirectory() as scratch:
            measure_all(args, runs, Path(scratch))
    text, times = table(runs.rows), times_table(runs.rows)
    print(f"{text}\n\n{times}")
    if args.write:
        common.write_between(PAGE, *MARKS, text)
        common.write_between(PAGE, *TIMES, times)
        draw(runs.rows, CHART)
        CHART.with_suffix(".svg").unlink()  # pages show the PNG


def measure_all(args: argparse.Namespace, runs: common.Runs, scratch: Path) -> None:
    """Measure what is not among the rows yet."""
    renderer = Renderer(args.device)
    where = common.environment(renderer.device, schedule_for(renderer.device))
    models = [smoke_model(scratch)] if args.smoke else args.models
    for model in map(load_model, models):
        measure(model.path.name, model.splats, cameras_of(model), model.background, runs, scratch, renderer, where)
    for n in args.random:
        measure("random", random_splats(n), [], (0.0, 0.0, 0.0), runs, scratch, renderer, where)


def cameras_of(model: LoadedModel) -> list[Camera]:
    return [named.camera for named in model.read_cameras()[:CAMERAS]]


def measure(
    name: str,
    splats: Splats,
    cameras: list[Camera],
    background: Any,
    runs: common.Runs,
    scratch: Path,
    renderer: Renderer,
    where: dict[str, Any],
) -> None:
    """Measure all formats of a model."""

    def pictures(of: Splats) -> list[np.ndarray]:
        return [renderer.render(of, camera, background).color for camera in cameras]

    def mean_psnr(before: Iterable[np.ndarray], after: Iterable[np.ndarray]) -> float | None:
        values = [min(psnr(a, b), MAX_PSNR) for a, b in zip(before, after, strict=True)]
        return round(statistics.mean(values), 2) if values else None

    formats = [one for one in FORMATS if find_spec(one.library)]
    cases = [{"model": name, "shape": splats.shape, "splats": len(splats), "format": f.name, **where} for f in formats]
    todo = [(case, one) for case, one in zip(cases, formats, strict=True) if case not in runs]
    if not todo:
        return
    gaussians = nearest_gaussians(splats)
    model_pictures, of_gaussians = pictures(splats), pictures(gaussians)
    for case, one in todo:
        shapes = WRITTEN[one.ending].shapes
        skewed = (shapes is None or splats.shape in shapes) and not one.gaussians
        held = splats if skewed else gaussians
        path = scratch / f"file{one.ending}"
        written, read = [], []
        for _ in range(REPEATS if len(splats) < MANY else 1):
            path.unlink(missing_ok=True)
            start = time.perf_counter()
            one.write(path, held)
            middle = time.perf_counter()
            back = Splats.load(path)
            written.append(middle - start)
            read.append(time.perf_counter() - middle)
        found = pictures(back)
        runs.add(
            case
            | {
                "bytes": path.stat().st_size,
                "psnr": mean_psnr(model_pictures, found),
                "rounding_psnr": mean_psnr(model_pictures if skewed else of_gaussians, found),
                "write_s": round(statistics.median(written), 3),
                "read_s": round(statistics.median(read), 3),
            }
        )
        path.unlink()


def random_splats(n: int) -> Splats:
    """Return random skew-normals of SH degree 3. Their bytes are nearly random, which no compression makes smaller."""
    rng = np.random.default_rng(0)
    arrays = {}
    for field in SKEW_NORMAL.schema(3):
        values = rng.standard_normal(public_shape(field, n), np.float32)
        if field.name == "log_scale":
            values -= 4
        elif field.name == "skew":
            values *= 0.5 / np.linalg.norm(values, axis=1, keepdims=True)
        elif field.name == "sh":
            values *= 0.2
        arrays[field.name] = values
    return Splats(SKEW_NORMAL.name, arrays)


def smoke_model(folder: Path) -> Path:
    """Return a folder with a tiny model."""
    from clsplat.cameras.cameras_json import named_cameras, write_cameras

    splats = random_splats(60)
    camera = Camera(48, 32, 40.0, 40.0, 24.0, 16.0, np.eye(4) + np.eye(4, k=3) * [0, 0, 4, 0])
    model = folder / "smoke"
    splats.save(model / "point_cloud" / "iteration_1" / "point_cloud.ply")
    write_cameras(model / "cameras.json", named_cameras(["a.png"], [camera]))
    return model


def latest(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the last row of each model, number of splats and format, in the order of FORMATS."""
    found = {(row["model"], row["splats"], row["format"]): row for row in rows}
    models = list(dict.fromkeys((model, splats) for model, splats, _ in found))
    return [found[*model, one.name] for model in models for one in FORMATS if (*model, one.name) in found]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of bytes and dB."""
    lines = ["| model | format | holds | MB | bytes a splat | rounding, dB | dB |", "|---|---|---|---:|---:|---:|---:|"]
    for row in latest(rows):
        if row["psnr"] is None:
            continue
        held = row["shape"] if holds_skew(row) else GAUSSIAN.name
        lines.append(
            f"| `{row['model']}` | {row['format']} | {held} | {row['bytes'] / 1e6:.2f} | "
            f"{row['bytes'] / row['splats']:.1f} | {row['rounding_psnr']:.1f} | {row['psnr']:.1f} |"
        )
    return "\n".join(lines)


def times_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of seconds, with the bytes of random splats."""
    lines = ["| splats | format | MB | written, s | read, s |", "|---:|---|---:|---:|---:|"]
    lines += [
        f"| {row['splats']} | {row['format']} | {row['bytes'] / 1e6:.2f} | {row['write_s']:.2f} | {row['read_s']:.2f} |"
        for row in latest(rows)
        if row["model"] == "random"
    ]
    return "\n".join(lines)


def ending_of(row: dict[str, Any]) -> str:
    return str(row["format"]).partition(",")[0]


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw PSNR against bytes of a splat, a panel for each model, with one marker for each format."""
    rows = [row for row in latest(rows) if row["psnr"] is not None]
    models, formats = (list(dict.fromkeys(row[name] for row in rows)) for name in ("model", "format"))
    markers = dict(zip(formats, "os^vDP*XhHd", strict=False))
    with chart_style.drawing(out, height=3.9) as figure:
        panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
        for panel, model in zip(panels, models, strict=True):
            for row in (row for row in rows if row["model"] == model):
                x, colour = row["bytes"] / row["splats"], _SKEWED if holds_skew(row) else _GAUSSIAN
                style = {"color": colour, "marker": markers[row["format"]], "linestyle": "none"}
                panel.plot(x, row["psnr"], label=row["format"], **style)
                if row["rounding_psnr"] - row["psnr"] > 0.5:
                    panel.plot(x, row["rounding_psnr"], markerfacecolor="none", **style)
            panel.set_xscale("log")
            panel.set_xlim(20, 350)
            panel.set_xticks(_TICKS, [str(tick) for tick in _TICKS])
            panel.minorticks_off()
            panel.set_title(model)
            panel.set_xlabel("bytes a splat")
        panels[0].set_ylabel("PSNR of the file's pictures, dB")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5)


def holds_skew(row: dict[str, Any]) -> bool:
    return WRITTEN[ending_of(row)].shapes != (GAUSSIAN.name,) and "Gaussians" not in row["format"]


if __name__ == "__main__":
    main()
