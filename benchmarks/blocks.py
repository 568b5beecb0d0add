"""Trainings in blocks against one run of as many splats and iterations: quality, seams, memory, time.

    python benchmarks/blocks.py [--cases fox:4:8000:1500 ...] [--workers 1]
    python benchmarks/blocks.py --page         # write the table of docs/blocks.md
    python benchmarks/blocks.py --smoke --cases NAME:1:100:20

A case is scene:resolution:cap:iterations; the iterations are those of a block. They are compared with two runs in one
piece. One has as many iterations as the coarse run, the blocks and the polish together. The other has as many as a
block: it is the same command without --blocks. Each training has a process of its own, whose largest memory counts.
Test views, one seed. Pixels near a seam show a place whose distance to a border is at most 5 % of the extent of the
scene.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import CLSPLAT, RESULTS, ROOT, Case, Runs, environment, parser, table, write_between
from numpy.typing import NDArray

from clsplat.blocks.cells import Cells
from clsplat.cameras.camera import Camera
from clsplat.device.device import open_device
from clsplat.models.model import load_model
from clsplat.rendering.renderer import Rendered, Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats

KEY = ("scene", "resolution", "cap", "iterations", "polish")
PAGE = ROOT / "docs" / "blocks.md"
MARKS = ("<!-- table of blocks.py -->", "<!-- end of the table of blocks.py -->")
NEAR_SEAM = 0.05  # of the scene's extent
BLOCKS = 4


def trained(command: list[str]) -> dict[str, Any]:
    """Run a training in a process of its own and return its largest memory [bytes] (Linux)."""
    code = (
        "import resource, subprocess, sys\n"
        "done = subprocess.run(sys.argv[1:])\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)\n"
        "sys.exit(done.returncode)"
    )
    done = subprocess.run([sys.executable, "-c", code, *command], stdout=subprocess.PIPE, text=True, encoding="utf-8")
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}")
    return {"bytes": int(done.stdout.split()[-1])}


def errors(scene: Scene, models: list[Splats], cells: Cells) -> list[dict[str, float]]:
    """Return for each model the mean PSNR of the test views, and the PSNR of all their pixels near a seam [dB].

    Where a pixel is near a seam is decided by the last model.
    """
    renderer, found = Renderer(), []
    seams = [
        seam_pixels(view.camera, renderer.render(models[-1], view.camera), cells, scene.extent) for view in scene.test
    ]
    for splats in models:
        squares = [
            (np.clip(renderer.render(splats, view.camera, scene.background).color, 0, 1) - view.image / 255.0) ** 2
            for view in scene.test
        ]
        near = np.concatenate([square[seam] for square, seam in zip(squares, seams, strict=True)])
        found.append(
            {
                "psnr": float(np.mean([-10 * math.log10(square.mean()) for square in squares])),
                "seam_psnr": -10 * math.log10(near.mean()) if len(near) else math.nan,
            }
        )
    return found


def seam_pixels(camera: Camera, shown: Rendered, cells: Cells, extent: float) -> NDArray[np.bool_]:
    """Return which pixels show a place near a border, (H, W)."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    z = shown.depth / np.maximum(shown.alpha, 1e-6)
    seen = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], axis=-1).reshape(-1, 3)
    pose = np.asarray(camera.cam_from_world)
    places = (seen - pose[:3, 3]) @ pose[:3, :3]
    near = cells.distance_to_border(places) <= NEAR_SEAM * extent
    found: NDArray[np.bool_] = near.reshape(shown.alpha.shape) & (shown.alpha > 0.5)
    return found


def measure(case: Case, polish: int, args: Any) -> dict[str, Any]:
    """Train both ways, and return the figures of each."""
    scene = case.load("test")
    total = (1 + BLOCKS) * case.iterations + polish
    with tempfile.TemporaryDirectory() as folder:
        blocks, whole, same = (Path(folder) / name for name in ("blocks", "whole", "same"))
        common = [*CLSPLAT, "train", str(scene.path), "-r", str(case.resolution), "--eval", "-q"]
        common += ["--cap-max", str(case.cap), "--background", ",".join(map(str, scene.background))]
        more = ["--blocks", "2x2", "--iterations", str(case.iterations), "--polish", str(polish)]
        if args.workers:
            more += ["--cluster", f"local:{args.workers}"]
        trained([*common, "-m", str(blocks), *more])
        one = trained([*common, "-m", str(whole), "--iterations", str(total)])
        trained([*common, "-m", str(same), "--iterations", str(case.iterations)])
        report = json.loads((blocks / "blocks.json").read_text(encoding="utf-8"))
        cells = Cells.from_json(report["partition"]["cells"])
        models = [load_model(path).splats for path in (blocks, same, whole)]
        found = errors(scene, models, cells)
        log = [json.loads(line) for line in (whole / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    rows = report["blocks"]
    return {
        **{f"blocks_{key}": round(value, 3) for key, value in found[0].items()},
        **{f"same_{key}": round(value, 3) for key, value in found[1].items()},
        **{f"whole_{key}": round(value, 3) for key, value in found[2].items()},
        "blocks_splats": len(models[0]),
        "whole_splats": len(models[2]),
        "block_device_bytes": max(row["device_bytes"] for row in rows),
        "block_bytes": max(row["peak_bytes"] for row in rows),
        "whole_bytes": one["bytes"],
        "block_seconds": [row["seconds"] for row in rows],
        "whole_seconds": log[-1]["seconds"],
        "total_iterations": total,
    }


def page(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table of all cases."""
    lines = [
        (
            f"`{row['scene']}`" + (f" `-r {row['resolution']}`" if row["resolution"] != -1 else ""),
            row["cap"],
            row["iterations"],
            row["polish"],
            f"{row['blocks_psnr']:.2f}",
            f"{row['same_psnr']:.2f}",
            f"{row['whole_psnr']:.2f}",
            f"{row['blocks_seam_psnr']:.2f}",
            f"{row['whole_seam_psnr']:.2f}",
            f"{row['block_bytes'] / 1e6:.0f}",
            f"{row['whole_bytes'] / 1e6:.0f}",
        )
        for row in rows
    ]
    head = ("scene", "splats", "iterations", "polish", "blocks [dB]", "one run, same command [dB]")
    head += ("one run, all iterations [dB]", "blocks, seams", "one run, seams", "a block [MB]", "one run [MB]")
    return table(head, lines, right=head[1:])


def main() -> None:
    flags = parser(__doc__, RESULTS / "blocks.jsonl", device=False, page=PAGE)
    flags.add_argument(
        "--cases",
        nargs="+",
        default=[
            *("fox:4:8000:1500", "fox:4:8000:5000", "south_building_large:4:20000:1000"),
            *("lego_full:4:20000:1000", "lego_full:4:20000:5000"),
        ],
    )
    flags.add_argument("--polish", type=int, help="iterations of the polish; default: half of those of a block")
    flags.add_argument("--workers", type=int, default=1, help="local workers; 0: train the blocks in one process")
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *MARKS, page(runs.rows))
        return
    for case in map(Case.parse, [] if args.table else args.cases):
        polish = case.iterations // 2 if args.polish is None else args.polish
        row = vars(case) | {"polish": polish}
        if row not in runs:
            device = open_device()
            runs.add(row | measure(case, polish, args) | environment(device, schedule_for(device)))
    print(page(runs.rows))


if __name__ == "__main__":
    main()
