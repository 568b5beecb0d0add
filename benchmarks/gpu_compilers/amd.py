"""AMD: clang with ROCm's device libraries, as Debian has them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from . import commands
from .programs import OPTIONS
from .usage import Compiler, CompilerError, Usage

_LIBRARIES = Path("/usr/lib/x86_64-linux-gnu/amdgcn/bitcode")
_MOST_WAVES = {"gfx90a": 8, "gfx1030": 16, "gfx1100": 16}  # of a SIMD
_WAVE = {"gfx90a": 64, "gfx1030": 32, "gfx1100": 32}
_ISA = {"gfx90a": "9010", "gfx1030": "10300", "gfx1100": "11000"}  # __oclc_ISA_version


def _missing() -> str | None:
    lacks = commands.lacks(commands.CLANG)
    if lacks:
        return f"{commands.CLANG} not found: {commands.LLVM_REMEDY}"
    if not _LIBRARIES.is_dir():
        return "ROCm's device libraries not found: `apt install rocm-device-libs`"
    return None


def _compile(_name: str, text: str, target: str, folder: Path) -> Mapping[str, Usage]:
    source, assembly = folder / "program.cl", folder / f"{target}.s"
    source.write_text(text, encoding="utf-8")
    report = commands.run(
        [
            commands.CLANG,
            *("-x", "cl", *OPTIONS, "-Xclang", "-finclude-default-header", "-O3"),
            *("--target=amdgcn-amd-amdhsa", f"-mcpu={target}", "-mcode-object-version=4"),
            f"--rocm-device-lib-path={_libraries(target, folder)}",
            *("-Rpass-analysis=kernel-resource-usage", "-S", source, "-o", assembly),
        ]
    )
    parts = re.split(r"remark: Function Name: (\w+)", report)
    kernels = dict(zip(parts[1::2], parts[2::2], strict=True))
    return {kernel: _usage(part, target) for kernel, part in kernels.items()}


def _usage(part: str, target: str) -> Usage:
    return Usage(
        registers=_number("VGPRs", part),
        local_bytes=_number(r"LDS Size \[bytes/block\]", part),
        stack_bytes=_number(r"ScratchSize \[bytes/lane\]", part),
        spills=_number("VGPRs Spill", part),
        width=_WAVE[target],
        occupancy=round(_number(r"Occupancy \[waves/SIMD\]", part) / _MOST_WAVES[target], 3),
    )


def _number(name: str, part: str) -> int:
    found = re.search(rf"remark:\s+{name}: (\d+)", part)
    if found is None:
        raise CompilerError(f"clang: no {name!r} in its remarks")
    return int(found[1])


def _libraries(target: str, folder: Path) -> Path:
    """A folder with the device libraries; the constant of a GPU that Debian's release does not know is added."""
    place = folder / "rocm" / "amdgcn" / "bitcode"
    if not place.is_dir():
        place.mkdir(parents=True)
        for library in _LIBRARIES.glob("*.bc"):
            (place / library.name).symlink_to(library)
    constant = place / f"oclc_isa_version_{target.removeprefix('gfx')}.bc"
    if not constant.exists():
        text = folder / "isa.ll"
        text.write_text(
            'target triple = "amdgcn-amd-amdhsa"\n'
            "@__oclc_ISA_version = linkonce_odr protected local_unnamed_addr addrspace(4) "
            f"constant i32 {_ISA[target]}\n",
            encoding="utf-8",
        )
        commands.run([commands.CLANG, "-x", "ir", "-emit-llvm", "-c", text, "-o", constant])
    return place


AMD = Compiler("AMD", tuple(_WAVE), _missing, _compile)
