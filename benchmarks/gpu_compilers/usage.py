"""What a kernel needs on a GPU, as its compiler reports it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources of one kernel on one GPU.

    Attributes
    ----------
    registers : per work-item (NVIDIA, AMD's vector registers) or per hardware thread (Intel).
    local_bytes : local memory of a work-group.
    stack_bytes : private memory of a work-item that is not in registers.
    spills : bytes (NVIDIA, Intel) or registers (AMD) that did not fit into the registers.
    width : work-items that run together.
    occupancy : share of the places for resident work-items that the kernel can fill, 0 to 1; None: not known.
    loops : instructions of each innermost loop, in order of their places; () if the compiler does not tell.
    around : instructions of the loops directly around innermost ones, in order of their places; () likewise.
    """

    registers: int
    local_bytes: int
    stack_bytes: int
    spills: int
    width: int
    occupancy: float | None = None
    loops: tuple[int, ...] = ()
    around: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Compiler:
    """The offline compiler of a vendor.

    Attributes
    ----------
    vendor : its name in the table.
    targets : the GPUs that it compiles for.
    missing : the reason why it cannot run here, with the remedy; None if it can.
    compile : (name, text, target, folder) to the usage of each kernel; writes its files into the folder.
    """

    vendor: str
    targets: tuple[str, ...]
    missing: Callable[[], str | None]
    compile: Callable[[str, str, str, Path], Mapping[str, Usage]]


class CompilerError(Exception):
    """A compiler refused a program; the text has its first lines."""
