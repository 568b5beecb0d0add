"""NVIDIA: clang to PTX with the built-ins of libdevice, then ptxas and nvdisasm of NVIDIA's packages on PyPI."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from . import commands
from .programs import OPTIONS, group_size
from .usage import Compiler, CompilerError, Usage

_BUILTINS = Path(__file__).with_name("nvidia_builtins.cl")
_CLANG = (
    commands.CLANG,
    *("-x", "cl", *OPTIONS, "-Xclang", "-finclude-default-header"),
    *("--target=nvptx64-nvidia-nvcl", "-Xclang", "-cl-ext=+cl_khr_fp64", "-O3", "-emit-llvm", "-c"),
    *("-Xclang", "-disable-llvm-passes", "-Wno-unused-function"),
)
# Division and square root as inexact as OpenCL allows, as NVIDIA's driver has them.
_LLC = ("-O3", "-mattr=+ptx78", "-fp-contract=fast", "-nvptx-prec-divf32=1", "-nvptx-prec-sqrtf32=0")
_WARP = 32
_REGISTERS = 65536  # of a multiprocessor; a warp takes a multiple of 256
# Limits of a multiprocessor: warps, groups and bytes of local memory. The last number is what each group takes itself.
# CUDA C++ Programming Guide, table "Technical Specifications per Compute Capability".
_LIMITS = {
    "sm_75": (32, 16, 64 << 10, 0),
    "sm_86": (48, 16, 100 << 10, 1 << 10),
    "sm_89": (48, 24, 100 << 10, 1 << 10),
    "sm_90": (64, 32, 228 << 10, 1 << 10),
}


def _libdevice() -> Path | None:
    return commands.in_packages("nvidia", "cuda_nvcc", "nvvm", "libdevice", "libdevice.10.bc")


def _ptxas() -> Path | None:
    return commands.in_packages("nvidia", "cuda_nvcc", "bin", "ptxas")


def _nvdisasm() -> Path | None:
    return commands.in_packages("nvidia", "cu13", "bin", "nvdisasm")


def _missing() -> str | None:
    lacks = commands.lacks(commands.CLANG, commands.LINK, commands.OPT, commands.LLC)
    if lacks:
        return f"{', '.join(lacks)} not found: {commands.LLVM_REMEDY}"
    if _libdevice() is None or _ptxas() is None or _nvdisasm() is None:
        return "ptxas and nvdisasm not found: `pip install nvidia-cuda-nvcc-cu12==12.9.* nvidia-cuda-nvdisasm`"
    return None


def _compile(name: str, text: str, target: str, folder: Path) -> Mapping[str, Usage]:
    libdevice, ptxas, nvdisasm = _libdevice(), _ptxas(), _nvdisasm()
    if libdevice is None or ptxas is None or nvdisasm is None:
        raise CompilerError(_missing() or "")
    linked = _linked(text, folder, libdevice)
    optimised, assembly, binary = (folder / f"{target}.{kind}" for kind in ("bc", "ptx", "cubin"))
    kept = ",".join(re.findall(r"kernel\s+void\s+(\w+)\(", text))
    passes = ("-passes=internalize,default<O3>", f"-internalize-public-api-list={kept}")
    commands.run([commands.OPT, f"-mcpu={target}", *passes, linked, "-o", optimised])
    commands.run([commands.LLC, f"-mcpu={target}", *_LLC, optimised, "-o", assembly])
    report = commands.run([ptxas, "-v", "-O3", f"-arch={target}", assembly, "-o", binary])
    listing = commands.run([nvdisasm, "-c", binary])
    return {kernel: _usage(name, kernel, part, target, listing) for kernel, part in _parts(report).items()}


@cache
def _linked(text: str, folder: Path, libdevice: Path) -> Path:
    """The program with the built-ins that it calls, before any optimisation."""
    source, code, builtins, both, linked = (
        folder / name for name in ("program.cl", "program.bc", "builtins.bc", "both.bc", "linked.bc")
    )
    source.write_text(text, encoding="utf-8")
    commands.run([*_CLANG, _BUILTINS, "-o", builtins])
    commands.run([*_CLANG, source, "-o", code])
    commands.run([commands.LINK, code, builtins, "-o", both])
    commands.run([commands.LINK, "--suppress-warnings", "--only-needed", both, libdevice, "-o", linked])
    return linked


def _parts(report: str) -> dict[str, str]:
    """The lines of ptxas about each kernel."""
    parts = re.split(r"Compiling entry function '(\w+)'.*", report)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def _usage(program: str, kernel: str, part: str, target: str, listing: str) -> Usage:
    stack, stores, loads = _numbers(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", part)
    (registers,) = _numbers(r"Used (\d+) registers", part)
    local = re.search(r"(\d+) bytes smem", part)
    local_bytes = int(local[1]) if local else 0
    inner, around = loops_of(listing, kernel)
    return Usage(
        registers=registers,
        local_bytes=local_bytes,
        stack_bytes=stack,
        spills=stores + loads,
        width=_WARP,
        occupancy=round(_occupancy(target, registers, local_bytes, group_size(program, kernel)), 3),
        loops=inner,
        around=around,
    )


def _numbers(pattern: str, text: str) -> tuple[int, ...]:
    found = re.search(pattern, text)
    if found is None:
        raise CompilerError(f"ptxas: no {pattern!r} in its report")
    return tuple(int(number) for number in found.groups())


def _occupancy(target: str, registers: int, local_bytes: int, group: int) -> float:
    """Share of a multiprocessor's warps that can be resident."""
    warps, groups, memory, reserved = _LIMITS[target]
    group_warps = -(-group // _WARP)
    by_registers = _REGISTERS // (-(-registers * _WARP // 256) * 256) // group_warps
    taken = -(-(local_bytes + reserved) // 128) * 128
    by_memory = memory // taken if taken else groups
    return min(by_registers, by_memory, groups, warps // group_warps) * group_warps / warps


def loops_of(listing: str, kernel: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the instructions of a kernel's innermost loops, and of the loops directly around them.

    A loop is what lies between a branch backwards and its target. Both are in the order of their places in nvdisasm's
    listing.
    """
    body = listing.split(f".text.{kernel}:", 1)[1].split("//----", 1)[0]
    labels: dict[str, int] = {}
    branches: list[tuple[int, str]] = []
    place = 0
    for line in body.splitlines():
        line = re.sub(r"/\*.*?\*/", "", line).strip()
        if label := re.match(r"(\.L_x_\d+):", line):
            labels[label[1]] = place
        elif re.match(r"(@!?U?P\w+\s+)?[A-Z][A-Z0-9_.]*.*;", line):
            if branch := re.search(r"\bBRA\b.*`\((\.L_x_\d+)\)", line):
                branches.append((place, branch[1]))
            place += 1
    loops = {(labels[name], end) for end, name in branches if name in labels and labels[name] < end}
    within = {loop: {other for other in loops - {loop} if _encloses(loop, other)} for loop in loops}
    inner = {loop for loop in loops if not within[loop]}
    around = {loop for loop in loops - inner if within[loop] <= inner}
    return _lengths(inner), _lengths(around)


def _encloses(loop: tuple[int, int], other: tuple[int, int]) -> bool:
    return loop[0] <= other[0] and other[1] <= loop[1]


def _lengths(loops: Iterable[tuple[int, int]]) -> tuple[int, ...]:
    return tuple(end - first + 1 for first, end in sorted(loops))


NVIDIA = Compiler("NVIDIA", tuple(_LIMITS), _missing, _compile)
