"""Images and training steps of clsplat beside those of gsplat, with the same splats on the same GPU; a JSON line each.

    python benchmarks/gsplat_steps.py [--splats 1000000] [--width 1920] [--height 1080] [--iterations 50]
    python benchmarks/gsplat_steps.py --table    # print the finished rows, run nothing
    python benchmarks/gsplat_steps.py --page     # write them into GPU.md
    python benchmarks/gsplat_steps.py --smoke --out FILE

gsplat needs PyTorch and a GPU with CUDA. Without them only clsplat is measured. The splats and cameras are those of
`clsplat bench`. A time is the wall time of an iteration, without a wait between iterations, as a median of five rounds.
Two tasks: `image` has no gradients. `step` is a training step: the image, its loss, all gradients and Adam.
clsplat's loss has SSIM. gsplat has no SSIM of its own, so its loss here is L1 alone, which is quicker. Adam is
PyTorch's fused one there, with a rate of 0, so that the splats stay the same.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import Any

import common
import numpy as np

from clsplat.device.device import Device, open_device
from clsplat.profiling.bench import bench_trainer
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats

KEY = ("system", "task", "splats", "width", "height", "device", "commit")
SHAPES = ("gaussian", "skew-normal")
ROUNDS, WARM_UP = 5, 10
PAGE = common.ROOT / "benchmarks" / "GPU.md"
_BEGIN, _END = "<!-- table of gsplat_steps.py -->", "<!-- end of the table of gsplat_steps.py -->"

# An iteration of each task, and the wait for the device.
Tasks = tuple[dict[str, Callable[[], Any]], Callable[[], Any]]


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "gsplat_steps.jsonl", page=PAGE)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    parser.add_argument("--iterations", type=int, default=50, help="of a round")
    args = parser.parse_args()
    if args.smoke:
        args.splats, args.width, args.height, args.iterations = 300, 64, 48, 2
    runs = common.Runs(args.out, KEY)
    if not (args.table or args.page):
        measure_all(runs, args)
    text = table(runs.rows)
    print(text)
    if args.page:
        common.write_between(PAGE, _BEGIN, _END, text)


def measure_all(runs: common.Runs, args: argparse.Namespace) -> None:
    """Measure the systems that are not in the results yet."""
    case = {"splats": args.splats, "width": args.width, "height": args.height}
    device = open_device(args.device)
    for system in (*SHAPES, "gsplat"):
        scene, splats = synthetic_scene(
            args.splats, args.width, args.height, "gaussian" if system == "gsplat" else system
        )
        if system != "gsplat":
            (tasks, finish), schedule = clsplat_tasks(scene, splats, device)
            name = f"clsplat {system}"
        elif has_gsplat():
            (tasks, finish), schedule = gsplat_tasks(scene, splats), ""
            name = f"gsplat {metadata.version('gsplat')}"
        else:
            print("no gsplat here: it needs PyTorch and CUDA")
            continue
        where = common.environment(device, schedule)
        for task, iteration in tasks.items():
            row = {"system": name, "task": task, **case, **where}
            if row in runs:
                continue
            times = [_time(iteration, finish, args.iterations) for _ in range(1 + ROUNDS)][1:]
            row |= {"ms": statistics.median(times), "least_ms": min(times), "most_ms": max(times)}
            runs.add(row)
            print(name, task, f"{row['ms']:.2f} ms", flush=True)


def _time(iteration: Callable[[], Any], finish: Callable[[], Any], n: int) -> float:
    """Return the wall time of one of n iterations [ms]. Some before them are not counted."""
    for _ in range(min(WARM_UP, n)):
        iteration()
    finish()
    start = time.perf_counter()
    for _ in range(n):
        iteration()
    finish()
    return 1e3 * (time.perf_counter() - start) / n


def clsplat_tasks(scene: Scene, splats: Splats, device: Device) -> tuple[Tasks, str]:
    """Return clsplat's image and step, over the training views in turn, and the schedule."""
    trainer = bench_trainer(scene, device, splats.shape, splats)
    cameras = itertools.cycle(view.camera for view in scene.train)

    def image() -> None:
        trainer.pipeline.forward(trainer.splats, next(cameras))

    return ({"image": image, "step": trainer.step}, device.finish), str(trainer.kernels.schedule)


def has_gsplat() -> bool:
    """Whether gsplat can run here."""
    try:
        import gsplat  # noqa: F401
        import torch
    except ImportError:
        return False
    return bool(torch.cuda.is_available())


def gsplat_tasks(scene: Scene, splats: Splats) -> Tasks:
    """Return gsplat's image and step, over the training views in turn."""
    import torch
    from gsplat import rasterization

    def tensor(array: Any) -> Any:
        return torch.tensor(np.ascontiguousarray(array, np.float32), device="cuda")

    cameras = [view.camera for view in scene.train]
    width, height = cameras[0].width, cameras[0].height
    views = [(tensor(camera.cam_from_world)[None], tensor(_intrinsics(camera))[None]) for camera in cameras]
    sh = tensor(splats.sh)
    leaves = {
        "means": tensor(splats.mean),
        "quats": tensor(splats.quat),
        "log_scales": tensor(splats.log_scale),
        "opacity_logits": tensor(splats.opacity_logit),
        "sh_0": sh[:, :1].contiguous(),
        "sh_rest": sh[:, 1:].contiguous(),
    }
    for leaf in leaves.values():
        leaf.requires_grad_(True)
    target = torch.rand((1, height, width, 3), device="cuda")
    optimizer = torch.optim.Adam(list(leaves.values()), lr=0.0, eps=1e-15, fused=True)
    order: Iterator[tuple[Any, Any]] = itertools.cycle(views)

    def render() -> Any:
        pose, intrinsics = next(order)
        return rasterization(
            means=leaves["means"],
            quats=leaves["quats"],
            scales=torch.exp(leaves["log_scales"]),
            opacities=torch.sigmoid(leaves["opacity_logits"]),
            colors=torch.cat((leaves["sh_0"], leaves["sh_rest"]), dim=1),
            viewmats=pose,
            Ks=intrinsics,
            width=width,
            height=height,
            sh_degree=splats.sh_degree,
            packed=False,  # quicker here than packed
        )[0]

    def image() -> None:
        with torch.no_grad():
            render()

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        (render() - target).abs().mean().backward()
        optimizer.step()

    return {"image": image, "step": step}, torch.cuda.synchronize


def _intrinsics(camera: Any) -> list[list[float]]:
    return [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]


def table(rows: list[dict[str, Any]]) -> str:
    """Return a line for each case and system, with both tasks."""
    lines = []
    for (width, height, n, device, system, commit), group in common.groups(
        rows, "width", "height", "splats", "device", "system", "commit"
    ).items():
        tasks = {row["task"]: row for row in group}
        cells = [f"{tasks[task]['ms']:.2f}" if task in tasks else "" for task in ("image", "step")]
        lines.append([device, f"{width}×{height}", n, system, group[0]["schedule"], *cells, commit])
    return common.table(["device", "image", "splats", "system", "schedule", "image [ms]", "step [ms]", "commit"], lines)


if __name__ == "__main__":
    main()
