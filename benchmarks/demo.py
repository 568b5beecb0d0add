"""Time `clsplat demo` as a new user meets it: no compiled kernel, no measured schedule in any cache.

python benchmarks/demo.py [--device 0:0] [--out benchmarks/results/demo.jsonl]
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import common

from clsplat.device.device import open_device


def main() -> None:
    args = common.parser(__doc__, common.RESULTS / "demo.jsonl", table=False, smoke=False).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        # The caches of PoCL, Intel and pyopencl all start empty.
        fresh = {"POCL_CACHE_DIR": root / "pocl", "XDG_CACHE_HOME": root / "cache", "HOME": root / "home"}
        (root / "home").mkdir()
        environment = os.environ | {key: str(value) for key, value in fresh.items()}
        command = [*common.CLSPLAT, "demo", str(root / "out"), "--quiet"]
        command += ["--device", args.device] if args.device else []
        start = time.perf_counter()
        subprocess.run(command, env=environment, check=True)
        seconds = time.perf_counter() - start
        results = json.loads((root / "out" / "model" / "results.json").read_text(encoding="utf-8"))
        schedules = json.loads((root / "cache" / "clsplat" / "schedules.json").read_text(encoding="utf-8"))
    measured = next(iter(results.values()))
    device = open_device(args.device)
    row = {
        "seconds": seconds,
        "load": common.load_average(),
        **{key: measured[key] for key in ("PSNR", "SSIM", "render_ms", "splats", "bytes")},
    }
    common.append(args.out, row | common.environment(device, next(iter(schedules.values()))))
    print(
        f"{device.info}: demo from empty caches {seconds:.0f} s, test PSNR {row['PSNR']:.2f} dB, "
        f"SSIM {row['SSIM']:.4f}, {row['splats']} splats"
    )


if __name__ == "__main__":
    main()
