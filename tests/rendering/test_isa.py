"""The offline compilers of GPUs: no kernel spills or needs more than it did, and the reports are read right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import isa
import pytest
from gpu_compilers import nvidia
from gpu_compilers.programs import GPU_SCHEDULES, SHAPES, programs
from gpu_compilers.usage import Compiler, CompilerError, Usage

STORED = isa.read()
QUICK = {"NVIDIA": "sm_90", "AMD": "gfx1100", "Intel": "dg2"}  # compiled by the default suite
TARGETS = [
    pytest.param(compiler, target, marks=[] if target == QUICK[compiler.vendor] else [pytest.mark.slow], id=target)
    for compiler in isa.COMPILERS
    for target in compiler.targets
]


@pytest.mark.parametrize(("compiler", "target"), TARGETS)
def test_no_kernel_needs_more_than_it_did(compiler: Compiler, target: str) -> None:
    reason = compiler.missing()
    if reason is not None:
        pytest.skip(reason)
    found = isa.compiled(compiler, target)
    assert list(isa.faults(found, STORED)) == []
    assert set(found) == {key for key in STORED if key.startswith(f"{target} | ")}, "run isa.py --write"


def test_pixels_stay_in_registers() -> None:
    """The stored results have no private memory where pixels are drawn, on any GPU, shape and schedule."""
    drawn = {key: usage for key, usage in STORED.items() if key.split(" | ")[-1] in isa.STACK_FREE}
    targets = [target for compiler in isa.COMPILERS for target in compiler.targets]
    assert len(drawn) == len(targets) * len(SHAPES) * len(GPU_SCHEDULES) * len(isa.STACK_FREE)
    assert {(usage.stack_bytes, usage.spills) for usage in drawn.values()} == {(0, 0)}


def test_the_page_has_the_stored_results() -> None:
    page = isa.PAGE.read_text(encoding="utf-8")
    for table in isa.tables(STORED):
        assert table in page, "run isa.py --write"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spills": 8}, "8 spilled"),
        ({"stack_bytes": 112}, "112 bytes of private memory, 0 before"),
        ({"occupancy": 0.5}, "occupancy 50%, 100% before"),
        ({"width": 16}, "16 work-items run together, 32 before"),
    ],
)
def test_a_kernel_that_needs_more_is_named(change: dict[str, float], message: str) -> None:
    before = Usage(registers=40, local_bytes=0, stack_bytes=0, spills=0, width=32, occupancy=1.0)
    key = "sm_90 | sort | radix_scan"
    assert list(isa.faults({key: before}, {key: before})) == []
    assert list(isa.faults({key: replace(before, **change)}, {key: before})) == [f"{key}: {message}"]
    assert list(isa.faults({key: before}, {})) == [f"{key}: not in the stored results; run with --write"]


def test_an_index_that_is_not_known_is_found(tmp_path: Path) -> None:
    """A planted fault: the blocks of a work-item are walked with a start and a step that no compiler knows."""
    if nvidia.NVIDIA.missing() is not None:
        pytest.skip(str(nvidia.NVIDIA.missing()))
    name = "pixels gaussian gpu64"
    text = programs()[name]
    unrolled = "UNROLL for (int v = 0; v < VECS; ++v)"
    assert text.count(unrolled) == 1
    walked = text.replace(unrolled, "for (int v = (set) & 1u; v < VECS; v += 1 + ((set) & 2u))")
    usages = nvidia.NVIDIA.compile(name, walked, "sm_90", tmp_path)
    found = {f"sm_90 | {name} | {kernel}": usage for kernel, usage in usages.items()}
    assert any("rasterize_vjp" in line and "private memory" in line for line in isa.faults(found, STORED))


@pytest.mark.parametrize("compiler", isa.COMPILERS, ids=lambda compiler: compiler.vendor)
def test_a_program_that_does_not_compile_is_one_error(compiler: Compiler, tmp_path: Path) -> None:
    if compiler.missing() is not None:
        pytest.skip(str(compiler.missing()))
    with pytest.raises(CompilerError, match="error"):
        compiler.compile("sort", "kernel void broken(global int *a) { a[0] = b; }", compiler.targets[0], tmp_path)


def test_loops_are_counted() -> None:
    listing = """
.text.other:
        /*0000*/ EXIT ;
//---- end
.text.walk:
        /*0000*/ MOV R1, c[0x0] ;
.L_x_2:
        /*0010*/ IADD3 R2, R2, 0x1 ;
.L_x_1:
        /*0020*/ FFMA R3, R3, R4, R5 ;
        /*0030*/ @P0 BRA `(.L_x_1) ;
        /*0040*/ @!P1 BRA `(.L_x_2) ;
        /*0050*/ EXIT ;
.L_x_9:
        /*0060*/ BRA `(.L_x_9) ;
//---- end
"""
    assert nvidia.loops_of(listing, "walk") == ((2,), (4,))
    assert nvidia.loops_of(listing, "other") == ((), ())
