"""What each form of the arithmetic costs and gains: errors against the double build beside time, on trained scenes.

    python benchmarks/arithmetic.py [--device 0:0] [--scenes fox kitchen] [--shapes gaussian skew-normal bisected-skew]
    python benchmarks/arithmetic.py --table                   # print what is there, run nothing
    python benchmarks/arithmetic.py --smoke --out FILE        # some seconds, for tests

A scene and shape is trained once. Then each variant renders test views and takes the gradient of a random loss, in
turn with all others: medians of the device's own clock for projection, rasteriser and their gradients, and their sum
relative to the default's. Errors: root mean square over pixels and channels of the image; of the gradients the
largest, over fields, of the relative Euclidean norms. The reference of a cutoff is the double build with a cutoff of
1e-5, that of all others the double build with the same cutoff. `psnr_change` [dB]: on these views, against the
reference's. Normalisations are trained one by one: their psnr_change is that of other models, the mean over seeds,
against `peak`. A JSON line each; lines that are there are not made again. benchmarks/frontier.py draws them.

Some lines of the results come from the commit with the tag `before-diet`: other forms of exp and Phi, colour in half
precision, other tiles. They were slower or less accurate, so this version has one form of each.
"""

from __future__ import annotations

import argparse
import statistics
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import common
import numpy as np

from clsplat.device.device import Device, open_device
from clsplat.device.schedule import Schedule
from clsplat.device.trace import recorded
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene, load_scene
from clsplat.splats.shapes import NORMALISATIONS, shape_named
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer

RESOLUTION = {"fox": 2}
STAGES = ("project_splats", "rasterize", "rasterize_vjp", "project_splats_vjp")
FINE = 1e-5  # cutoff that stands for none


@dataclass(frozen=True)
class Variant:
    """One choice, everything else as it is by default."""

    name: str
    kind: str
    options: dict[str, Any] = field(default_factory=dict)  # of Renderer
    reference: dict[str, Any] = field(default_factory=dict)  # of the double Renderer it is compared with


def variants() -> list[Variant]:
    """The default first."""
    found = [Variant("default", "default"), Variant("8 lanes", "lanes", {"schedule": Schedule(1, 32, 8)})]
    fine = {"alpha_min": FINE}
    found.append(Variant("cutoff 1/255", "cutoff", {}, fine))
    found += [Variant(f"cutoff 1/{part}", "cutoff", {"alpha_min": 1 / part}, fine) for part in (1000, 128, 64, 32)]
    found += [Variant(f"finished at {t:g}", "finish", {"t_min": t}, {"t_min": 1e-6}) for t in (1e-4, 1e-3, 1e-2)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["fox", "kitchen"])
    parser.add_argument("--shapes", nargs="+", default=["gaussian", "skew-normal", "bisected-skew"])
    parser.add_argument("--cap", type=int, default=10_000)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "arithmetic.jsonl")
    parser.add_argument("--variants", type=int, help="only so many of them")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    if args.smoke:
        args.shapes, args.cap, args.iterations, args.repeats, args.seeds = ["gaussian"], 60, 4, 1, [0]
        args.variants = 2
    if not args.table:
        device = open_device(args.device)
        for name in args.scenes:
            scene = load_scene(common.data_folder() / name, resolution=RESOLUTION.get(name, -1), eval=True)
            for shape in args.shapes:
                run(scene, shape, device, args)
    print_table(common.read(args.out))


def run(scene: Scene, shape: str, device: Device, args: argparse.Namespace) -> None:
    """The lines of a scene and shape that are not there yet."""
    identity = {
        "scene": scene.name,
        "shape": shape,
        "platform": device.info.platform,
        "cap": args.cap,
        "iterations": args.iterations,
    }
    there = {row["variant"] for row in common.read(args.out) if identity.items() <= row.items()}
    variants_left = [v for v in variants()[: args.variants] if v.name not in there]
    trained = {}
    if variants_left:
        trained["peak", args.seeds[0]] = splats = train(scene, shape, device, args)
        for row in measure(scene, splats, device, variants_left, args.repeats):
            common.append(args.out, row | identity)
    others = [n for n in NORMALISATIONS if f"normalisation {n}" not in there]
    if not shape_named(shape).normalised or not others:
        return
    psnr = {}
    for name in {"peak", *others}:
        models = [trained.get((name, seed)) or train(scene, shape, device, args, name, seed) for seed in args.seeds]
        psnr[name] = [evaluate(Renderer(device), model, scene.test).psnr for model in models]
    for name in others:
        change = statistics.fmean(psnr[name]) - statistics.fmean(psnr["peak"])
        common.append(
            args.out,
            common.environment(device, "")
            | identity
            | {
                "variant": f"normalisation {name}",
                "kind": "normalisation",
                "image_error": None,
                "gradient_error": None,
                "psnr_change": change,
                "psnr": psnr[name],
                "load": common.load_average(),
            },
        )


def train(
    scene: Scene, shape: str, device: Device, args: argparse.Namespace, normalisation: str = "peak", seed: int = 0
) -> Splats:
    config = TrainConfig(
        shape=shape, iterations=args.iterations, cap_max=args.cap, seed=seed, normalisation=normalisation
    )
    return Trainer(scene, config, device=device).run().splats


def measure(
    scene: Scene, splats: Splats, device: Device, variants_left: list[Variant], repeats: int
) -> list[dict[str, Any]]:
    """A row each; the default is timed with them in any case."""
    timed = variants_left if variants_left[0].name == "default" else [Variant("default", "default"), *variants_left]
    renderers = {v.name: Renderer(device, **v.options) for v in timed}
    views = scene.test[:3]
    rng = np.random.default_rng(0)
    losses = [rng.normal(size=view.image.shape) for view in views]
    times: dict[str, dict[str, list[float]]] = {v.name: defaultdict(list) for v in timed}
    for turn in range(repeats + 1):  # the first builds
        for name, renderer in renderers.items():
            with recorded(device) as launches:
                renderer.render(splats, views[0].camera)
                renderer.backward(losses[0])
            for stage in STAGES if turn else ():
                times[name][stage].append(sum(launch.ms for launch in launches if launch.name == stage))
    medians = {name: {stage: statistics.median(ms) for stage, ms in each.items()} for name, each in times.items()}
    truths: dict[str, Any] = {}
    rows = []
    for v in variants_left:
        key = repr(v.reference)
        if key not in truths:
            truths[key] = outputs(Renderer(device, "float64", **v.reference), scene, splats, losses)
        got = outputs(renderers[v.name], scene, splats, losses)
        image_error, gradient_error = errors(got, truths[key])
        ms = medians[v.name]
        rows.append(
            common.environment(device, renderers[v.name].schedule or "")
            | {
                "variant": v.name,
                "kind": v.kind,
                "splats": len(splats),
                "image_error": image_error,
                "gradient_error": gradient_error,
                "psnr_change": got["psnr"] - truths[key]["psnr"],
                "raster_ms": ms["rasterize"],
                "raster_vjp_ms": ms["rasterize_vjp"],
                "ms": sum(ms.values()),
                "relative_ms": sum(ms.values()) / sum(medians["default"].values()),
                "load": common.load_average(),
            }
        )
    return rows


def outputs(renderer: Renderer, scene: Scene, splats: Splats, losses: list[np.ndarray]) -> dict[str, Any]:
    """Images, gradients and PSNR of the test views that have a loss."""
    images, gradients = [], []
    views = scene.test[: len(losses)]
    for view, loss in zip(views, losses, strict=True):
        images.append(renderer.render(splats, view.camera).color)
        gradients.append(renderer.backward(loss))
    return {"images": images, "gradients": gradients, "psnr": evaluate(renderer, splats, views).psnr}


def errors(got: dict[str, Any], truth: dict[str, Any]) -> tuple[float, float]:
    """Errors of images (root mean square) and of gradients (the worst field's relative norm)."""
    image = np.sqrt(np.mean([np.mean((a - b) ** 2) for a, b in zip(got["images"], truth["images"], strict=True)]))
    worst = 0.0
    for a, b in zip(got["gradients"], truth["gradients"], strict=True):
        worst = max(worst, *(float(np.linalg.norm(a[name] - b[name]) / np.linalg.norm(b[name])) for name in b))
    return float(image), worst


def print_table(rows: list[dict[str, Any]]) -> None:
    titles = [
        "scene",
        "shape",
        "platform",
        "variant",
        "image error",
        "gradient error",
        "PSNR change [dB]",
        "forward [ms]",
        "gradient [ms]",
        "time of default",
    ]
    print("| " + " | ".join(titles) + " |\n|" + "---|" * len(titles))
    for row in rows:
        cells = [row["scene"], row["shape"], row["platform"].split()[0], row["variant"]]
        cells += ["" if row[key] is None else f"{row[key]:.1e}" for key in ("image_error", "gradient_error")]
        cells.append(f"{row['psnr_change']:+.4f}")
        cells += [f"{row[key]:.2f}" if key in row else "" for key in ("raster_ms", "raster_vjp_ms", "relative_ms")]
        print("| " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()
