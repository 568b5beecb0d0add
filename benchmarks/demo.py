"""Time `clsplat demo` as a new user meets it: no compiled kernel, no measured schedule in any cache.

python benchmarks/demo.py [--device 0:0] [--out benchmarks/results/demo.jsonl]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common

from clsplat.device.device import open_device


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="as for clsplat")
    parser.add_argument("--out", type=Path, default=common.RESULTS / "demo.jsonl")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        # PoCL's, Intel's and pyopencl's caches all start empty.
        fresh = {"POCL_CACHE_DIR": root / "pocl", "XDG_CACHE_HOME": root / "cache", "HOME": root / "home"}
        (root / "home").mkdir()
        environment = os.environ | {key: str(value) for key, value in fresh.items()}
        command = [str(Path(sys.executable).with_name("clsplat")), "demo", str(root / "out"), "--quiet"]
        command += ["--device", args.device] if args.device else []
        start = time.perf_counter()
        subprocess.run(command, env=environment, check=True)
        seconds = time.perf_counter() - start
        results = json.loads((root / "out" / "model" / "results.json").read_text())
        schedules = json.loads((root / "cache" / "clsplat" / "schedules.json").read_text())
    measured = next(iter(results.values()))
    device = open_device(args.device)
    row = {
        "seconds": seconds,
        "load": os.getloadavg()[0],
        **{key: measured[key] for key in ("PSNR", "SSIM", "render_ms", "splats", "bytes")},
    }
    common.append(args.out, row | common.environment(device, next(iter(schedules.values()))))
    print(
        f"{device.info}: demo from empty caches {seconds:.0f} s, test PSNR {row['PSNR']:.2f} dB, "
        f"SSIM {row['SSIM']:.4f}, {row['splats']} splats"
    )


if __name__ == "__main__":
    main()
