"""Intel: ocloc of Debian's packages, unpacked beside the cache of kernels, because installing it adds a driver."""

from __future__ import annotations

import os
import re
import shutil
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from unittest import mock

from clsplat.device.program_cache import cache_folder

from . import commands
from .programs import OPTIONS
from .usage import Compiler, CompilerError, Usage

_PACKAGES = (
    *("intel-opencl-icd", "libigc1", "libigdfcl1", "libigdgmm12"),
    *("libopencl-clang14", "libllvmspirvlib14", "libclang-cpp14", "libllvm14"),
)
_TARGETS = ("tgllp", "dg2")  # integrated graphics of 2020 and later, Arc


def fetch() -> None:
    """Download the packages of Debian 12 and unpack them.

    Raises
    ------
    CompilerError : there is no `apt-get` with these packages, or no network.
    """
    place = _place()
    with tempfile.TemporaryDirectory() as folder:
        commands.run(["apt-get", "download", *_PACKAGES], cwd=Path(folder))
        unpacked = Path(folder, "unpacked")
        for package in Path(folder).glob("*.deb"):
            commands.run(["dpkg", "-x", package, unpacked])
        shutil.rmtree(place, ignore_errors=True)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(unpacked, place, symlinks=True)


def _place() -> Path:
    return cache_folder() / "ocloc"


def _missing() -> str | None:
    if not (_place() / "usr" / "bin" / "ocloc").is_file():
        return "ocloc not found: `python benchmarks/isa.py --fetch-intel` on Debian 12"
    return None


def _compile(_name: str, text: str, target: str, folder: Path) -> Mapping[str, Usage]:
    source, out = folder / "program.cl", folder / target
    source.write_text(text, encoding="utf-8")
    libraries = _place() / "usr" / "lib" / "x86_64-linux-gnu"
    paths = f"{libraries}:{libraries.parent / 'llvm-14' / 'lib'}"
    with mock.patch.dict(os.environ, LD_LIBRARY_PATH=paths):
        commands.run(
            [
                _place() / "usr" / "bin" / "ocloc",
                *("compile", "-file", source, "-device", target, "-options", " ".join(OPTIONS)),
                *("-internal_options", "-cl-intel-allow-zebin", "-output", "program", "-output_no_suffix"),
                *("-out_dir", out),
            ]
        )
    binary = next((path for path in (out / "program.bin", out / "program") if path.is_file()), None)
    if binary is None:
        raise CompilerError(f"ocloc: no binary for {target}")
    return _usages(_section(binary.read_bytes(), ".ze_info"))


def _section(elf: bytes, name: str) -> str:
    """The text of a section of an ELF file of 64 bits (System V ABI, "ELF Header", "Sections")."""
    (table,) = struct.unpack_from("<Q", elf, 40)
    size, count, names = struct.unpack_from("<HHH", elf, 58)
    sections = [struct.unpack_from("<IIQQQQ", elf, table + i * size) for i in range(count)]
    for name_at, _kind, _flags, _address, start, length in sections:
        begin = sections[names][4] + name_at
        if elf[begin : elf.index(b"\0", begin)].decode() == name:
            return elf[start : start + length].decode()
    raise CompilerError(f"ocloc: no section {name} in its binary")


def _usages(info: str) -> dict[str, Usage]:
    """The usage of each kernel in the text of `.ze_info` (oneAPI, "ZEInfo")."""
    kernels = info.split("kernels:", 1)[1].split("\nkernels_misc_info", 1)[0]
    result: dict[str, Usage] = {}
    for part in re.split(r"\n  - name:\s+", kernels)[1:]:
        name = part.split()[0]
        if name.startswith("Intel_Symbol_Table"):
            continue
        memory = {use: int(size) for use, size in re.findall(r"usage:\s+(\w+)\s+size:\s+(\d+)", part)}
        result[name] = Usage(
            registers=_number("grf_count", part),
            local_bytes=_number("slm_size", part),
            stack_bytes=memory.get("private_space", 0) or memory.get("single_space", 0) // _number("simd_size", part),
            spills=memory.get("spill_fill_space", 0),
            width=_number("simd_size", part),
        )
    return result


def _number(name: str, part: str) -> int:
    found = re.search(rf"\b{name}:\s+(\d+)", part)
    return int(found[1]) if found else 0


INTEL = Compiler("Intel", _TARGETS, _missing, _compile)
