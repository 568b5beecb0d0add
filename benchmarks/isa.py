"""Registers, memory and occupancy of every kernel on GPUs, by their compilers, without a GPU.

    python benchmarks/isa.py --write            # compile, store the results and write GPU.md
    python benchmarks/isa.py                    # compile and compare with the stored results
    python benchmarks/isa.py --fetch-intel      # download Intel's compiler of Debian 12, without installing it

The compilers are clang 19 and ROCm's device libraries (`apt install clang-19 llvm-19 rocm-device-libs`), NVIDIA's ptxas
and nvdisasm (`pip install nvidia-cuda-nvcc-cu12==12.9.* nvidia-cuda-nvdisasm`) and ocloc. Vendors whose compilers are
missing are left out, with the reason. The exit code is 1 if a kernel needs more than it did. Drivers have other
versions of these compilers, so registers may differ by some.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import common
from gpu_compilers import intel
from gpu_compilers.amd import AMD
from gpu_compilers.nvidia import NVIDIA
from gpu_compilers.programs import programs
from gpu_compilers.usage import Compiler, CompilerError, Usage

OUT = common.RESULTS / "isa.json"
PAGE = common.ROOT / "benchmarks" / "GPU.md"
COMPILERS = (NVIDIA, AMD, intel.INTEL)
STACK_FREE = ("rasterize", "rasterize_vjp")  # their loops run for each splat and pixel
_BEGIN, _END = "<!-- table of isa.py -->", "<!-- end of the table -->"

Usages = dict[str, Usage]  # by "target | program | kernel"


def main() -> None:
    parser = common.parser(__doc__, OUT, device=False, table=False, smoke=False)
    parser.add_argument("--write", action="store_true", help="store the results, and write the table of GPU.md")
    parser.add_argument("--fetch-intel", action="store_true", help="download Intel's compiler")
    args = parser.parse_args()
    try:
        if args.fetch_intel:
            intel.fetch()
            return
        found: Usages = {}
        for compiler in COMPILERS:
            reason = compiler.missing()
            if reason is not None:
                print(f"{compiler.vendor} left out: {reason}", file=sys.stderr)
                continue
            for target in compiler.targets:
                found |= compiled(compiler, target)
                print(f"{compiler.vendor} {target}: compiled", file=sys.stderr)
    except CompilerError as error:
        sys.exit(str(error))
    stored = read(args.out)
    if args.write:
        compiled_for = {key.split(" | ")[0] for key in found}
        stored = {key: usage for key, usage in stored.items() if key.split(" | ")[0] not in compiled_for} | found
        args.out.write_text(
            json.dumps({key: asdict(stored[key]) for key in sorted(stored)}, indent=1) + "\n", encoding="utf-8"
        )
        common.write_between(PAGE, _BEGIN, _END, "\n\n".join(tables(stored)))
        return
    worse = list(faults(found, stored))
    print("\n".join(worse) or f"{len(found)} kernels need no more than the stored results")
    sys.exit(1 if worse else 0)


def compiled(compiler: Compiler, target: str) -> Usages:
    """Return the usage of each kernel of all programs."""
    found: Usages = {}
    for name, text in programs().items():
        with tempfile.TemporaryDirectory() as folder:
            usages = compiler.compile(name, text, target, Path(folder))
        found |= {f"{target} | {name} | {kernel}": usage for kernel, usage in usages.items()}
    return found


def read(path: Path = OUT) -> Usages:
    """Return the stored results; {} if there are none."""
    if not path.exists():
        return {}
    stored = json.loads(path.read_text(encoding="utf-8"))
    loops = ("loops", "around")
    return {
        key: Usage(**{**values, **{name: tuple(values.get(name, ())) for name in loops}})
        for key, values in stored.items()
    }


def faults(found: Usages, stored: Usages) -> Iterator[str]:
    """Yield a line for each kernel that spills, that keeps pixels in memory, or that needs more than it did."""
    for key, usage in found.items():
        before = stored.get(key)
        if usage.spills:
            yield f"{key}: {usage.spills} spilled"
        if key.split(" | ")[-1] in STACK_FREE and usage.stack_bytes:
            yield f"{key}: {usage.stack_bytes} bytes of private memory"
        if before is None:
            yield f"{key}: not in the stored results; run with --write"
            continue
        if usage.stack_bytes > before.stack_bytes:
            yield f"{key}: {usage.stack_bytes} bytes of private memory, {before.stack_bytes} before"
        if usage.occupancy is not None and before.occupancy is not None and usage.occupancy < before.occupancy:
            yield f"{key}: occupancy {usage.occupancy:.0%}, {before.occupancy:.0%} before"
        if usage.width < before.width:
            yield f"{key}: {usage.width} work-items run together, {before.width} before"


def tables(stored: Usages) -> Iterator[str]:
    """Yield a table for each vendor: a row for each kernel, a column for each GPU."""
    for compiler in COMPILERS:
        rows = sorted({tuple(key.split(" | ")[1:]) for key in stored if key.split(" | ")[0] in compiler.targets})
        if not rows:
            continue
        lines = [
            f"### {compiler.vendor}",
            "",
            "| program | kernel | " + " | ".join(compiler.targets) + " |",
            "|---|---|" + "---|" * len(compiler.targets),
        ]
        for program, kernel in rows:
            cells = [cell(stored.get(f"{target} | {program} | {kernel}")) for target in compiler.targets]
            lines.append(f"| {program} | `{kernel}` | " + " | ".join(cells) + " |")
        yield "\n".join(lines)


def cell(usage: Usage | None) -> str:
    """Return registers, local memory, private memory and occupancy (Intel: work-items together) in short."""
    if usage is None:
        return "–"
    last = f"{usage.width} wide" if usage.occupancy is None else f"{usage.occupancy:.0%}"
    spills = f", {usage.spills} spilled" if usage.spills else ""
    return f"{usage.registers}, {usage.local_bytes}, {usage.stack_bytes}{spills}, {last}"


if __name__ == "__main__":
    main()
