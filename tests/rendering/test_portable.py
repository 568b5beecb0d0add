"""Kernels avoid what compilers of some devices get wrong. The texts are checked, because few machines have them all.

Mesa's rusticl ignores that a struct is passed by value, so a function that writes to one changes the caller's. Its
translator to SPIR-V ends the process at clang's prefetch. Devices without double precision refuse or warn about double
literals. `RUSTICL_ENABLE=llvmpipe PYOPENCL_CTX=rusticl pytest` runs the other tests on rusticl (.ci/run).
"""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.resources import files

import pytest
from kernel_text import double_literals, struct_names, without_comments, writes_to_copies

from clsplat.device.device import Device
from clsplat.device.program import build_text

KERNELS = {
    f"{folder.name}/{file.name}": without_comments(file.read_text(encoding="utf-8"))
    for folder in files("clsplat_cl").iterdir()
    if folder.is_dir()
    for file in folder.iterdir()
    if file.name.endswith((".cl", ".clh"))
}
STRUCTS = set().union(*map(struct_names, KERNELS.values()))


def test_all_kernels_and_their_structs_are_read() -> None:
    assert len(KERNELS) > 35
    assert {"vec3", "sym2", "mat3", "splat_params", "side_terms", "lowering", "strip"} <= STRUCTS


@pytest.mark.parametrize("name", KERNELS)
def test_no_struct_is_written_that_came_by_value(name: str) -> None:
    assert writes_to_copies(KERNELS[name], STRUCTS) == []


@pytest.mark.parametrize(
    "body",
    ["s.x = 1;", "s = t;", "s.raw[2] += 1;", "s.x *= 2;", "f(&s);", "s.n++;", "--s.n;", "if (a) { s.x -= 1; }"],
)
def test_writes_to_a_copy_are_found(body: str) -> None:
    assert writes_to_copies(f"static inline int f(vec3 s, vreal a) {{ {body} return 0; }}", {"vec3"})


@pytest.mark.parametrize("body", ["return s.x == 1;", "t.s = 1;", "p->s = 1;", "k = s.x;", "return a && s.x;"])
def test_reads_of_a_copy_are_not_found(body: str) -> None:
    assert not writes_to_copies(f"static inline int f(vec3 s, vec3 *p) {{ {body} }}", {"vec3"})


@pytest.mark.parametrize("name", KERNELS)
def test_no_literal_is_a_double(name: str) -> None:
    assert double_literals(KERNELS[name]) == []


def test_double_literals_are_found() -> None:
    assert double_literals("(real)0.25 R(0.5) 0.5f 1e-3 R(-1e-4) v.s01 1 0x1e 2. R( 0.125)") == ["0.25", "1e-3", "2."]


def test_no_index_leaves_the_row_of_a_pointer() -> None:
    """A pointer to a row of a private array, indexed before the row, is undefined in C. rusticl reads zeros there."""
    for name, text in KERNELS.items():
        rows = re.findall(r"\(\s*\*\s*(\w+)\s*\)\s*\[", text)  # declares a pointer to an array
        assert not rows, f"{name}: index the array itself, not a pointer to its row: {rows}"


def test_prefetch_is_only_for_compilers_that_know_it(device: Device) -> None:
    """One file has it, behind the define."""
    assert [name for name, text in KERNELS.items() if "__builtin_" in text] == ["render/group.clh"]
    for platform, kind, has_prefetch in (
        ("Portable Computing Language", "CPU", True),
        ("Intel(R) OpenCL", "CPU", True),
        ("Intel(R) OpenCL Graphics", "GPU", False),
        ("rusticl", "CPU", False),
        ("NVIDIA CUDA", "GPU", False),
    ):
        assert replace(device.info, platform=platform, type=kind).has_prefetch is has_prefetch, platform
    text = (
        "#undef HAS_PREFETCH\n#define HAS_PREFETCH 0\n#define GROUP 1\n#define __builtin_prefetch undeclared\n"
        + (files("clsplat_cl") / "render" / "group.clh").read_text()
        + "kernel void fetch(global const float *p) { prefetch_reals(p, 4); }\n"
    )
    build_text(device, text)
