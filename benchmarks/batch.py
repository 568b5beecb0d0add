"""Iterations of several photos, on one device and on its equal parts: quality, time of a photo, and bits.

    python benchmarks/batch.py --cases fox:4:8000:2000 --batches 1,2,4 --devices cpu,cpu/2
    python benchmarks/batch.py --page      # write the table of docs/devices.md

A case is scene:resolution:cap:photos. All runs of a case learn as many photos: those of a batch of 4 have a quarter of
the iterations. PSNR is that of validation views. `bits` is a digest of the splats: runs that differ only in the number
of devices must have the same one.
"""

from __future__ import annotations

import statistics
import sys
from typing import Any

from common import RESULTS, ROOT, Case, Runs, background_of, environment, groups, parser, spread, table, write_between

from clsplat.comparison.measure import digest
from clsplat.device.several import open_devices
from clsplat.device.specs import count_devices
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

PAGE = ROOT / "docs" / "devices.md"
MARKS = ("<!-- table of batch.py -->", "<!-- end of the table of batch.py -->")
KEY = ("scene", "resolution", "cap", "iterations", "batch", "devices", "seed")


def run(case: Case, batch: int, devices: str, seed: int, runs: Runs) -> None:
    """Do one run, if it is not among `runs`."""
    row: dict[str, Any] = vars(case) | {"batch": batch, "devices": devices, "seed": seed}
    if row in runs or batch % count_devices(devices):
        return
    scene, background = case.load("validation"), background_of(case.scene)
    config = TrainConfig(
        iterations=-(-case.iterations // batch),
        cap_max=case.cap,
        batch=batch,
        device=devices,
        seed=seed,
        background=background,
    )
    model = train(scene, config)
    first = open_devices(devices)[0]
    psnr = evaluate(Renderer(), model.splats, scene.test, background).psnr
    measured = {
        "psnr": round(psnr, 3),
        "photo_ms": round(1e3 * model.seconds / (config.iterations * batch), 3),
        "splats": len(model.splats),
        "bits": digest(model.splats.arrays)[:12],
    }
    runs.add(row | measured | environment(first, schedule_for(first)))
    print(f"{case} batch {batch} on {devices}, seed {seed}: {psnr:.2f} dB", file=sys.stderr)


def page(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table with a row for each case, batch and devices."""
    lines = []
    for (scene, cap, photos, batch, devices), same in groups(
        rows, "scene", "cap", "iterations", "batch", "devices"
    ).items():
        psnr = [row["psnr"] for row in same]
        whole = {row["seed"]: row["bits"] for row in rows if _is_whole(row, same[0])}
        equal = all(whole.get(row["seed"]) == row["bits"] for row in same)
        time = statistics.median(row["photo_ms"] for row in same)
        bits = "yes" if equal else "no"
        mean = f"{statistics.fmean(psnr):.2f}{spread(psnr)}"
        lines.append((f"`{scene}`", cap, photos, batch, f"`{devices}`", len(psnr), mean, time, bits))
    head = ("scene", "splats", "photos", "batch", "devices", "seeds", "PSNR [dB]", "ms a photo", "bits of one device")
    return table(head, lines, right=(*head[1:4], *head[5:8]))


def _is_whole(row: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether a row is that of one device, with the case and the batch of another row."""
    same = ("scene", "resolution", "cap", "iterations", "batch")
    return count_devices(row["devices"]) == 1 and all(row[name] == other[name] for name in same)


def main() -> None:
    flags = parser(__doc__, RESULTS / "batch.jsonl", smoke=False, page=PAGE)
    flags.add_argument("--cases", nargs="+", default=["fox:4:8000:2000"])
    flags.add_argument("--batches", default="1,2,4")
    flags.add_argument("--devices", default="cpu,cpu/2")
    flags.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    args = flags.parse_args()
    runs = Runs(args.out, KEY)
    if args.page:
        write_between(PAGE, *MARKS, page(runs.rows))
        return
    if not args.table:
        for case in map(Case.parse, args.cases):
            for seed in args.seeds:
                for batch in map(int, args.batches.split(",")):
                    for devices in args.devices.split(","):
                        run(case, batch, devices, seed, runs)
    print(page(runs.rows))


if __name__ == "__main__":
    main()
