"""Parameters of kernels, read from OpenCL C text.

A kernel is written `kernel void name(...)`. Its parameters are `global [const] T *restrict name`, `local T *name` and
scalars of the types in `_SCALARS`. The type `real` is float or double. Lines between `#if NAME` or `#ifdef NAME` and
`#endif` are parameters that only some builds have; NAME is a define of the build.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ..errors import DeviceError

Real = Literal["float", "double"]

_SCALARS = {"int": np.int32, "uint": np.uint32, "ulong": np.uint64, "float": np.float32, "double": np.float64}
_ATTRIBUTE = r"__attribute__\s*\(\(.*?\)\)\)?\s*"  # the third parenthesis closes reqd_work_group_size(...)
_KERNEL = re.compile(rf"\b(?:__)?kernel\s+(?:{_ATTRIBUTE})*void\s+(\w+)\s*\(([^)]*)\)", re.S)
_CONDITION = re.compile(r"^\s*#\s*(if|ifdef)\s+(\w+)\s*\n(.*?)^\s*#\s*endif\b", re.S | re.M)
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a kernel. A scalar has a NumPy dtype."""

    name: str
    kind: Literal["buffer", "local", "scalar"]
    dtype: np.dtype[Any] | None = None


Signatures = dict[str, tuple[Parameter, ...]]


def parse_signatures(text: str, real: Real, defines: Mapping[str, int | float | str] | None = None) -> Signatures:
    """Return the parameters of every kernel in OpenCL C text, by kernel name.

    Parameters
    ----------
    text : the joined sources. real : the type that `real` stands for.
    defines : the defines of the build, which decide about parameters between `#if` and `#endif`.

    Raises
    ------
    DeviceError : a parameter of an unknown form, a condition that is not a define, or two kernels of one name with
        different parameters.
    """
    known = defines or {}
    signatures: dict[str, tuple[Parameter, ...]] = {}
    for name, whole in _KERNEL.findall(_COMMENT.sub(" ", text)):
        inside = _CONDITION.sub(partial(_kept, name, known), whole)
        parts = [part for part in inside.split(",") if part.strip() not in ("", "void")]
        parameters = tuple(_parse_parameter(name, part, real) for part in parts)
        if signatures.setdefault(name, parameters) != parameters:
            raise DeviceError(f"kernel {name}: two definitions with different parameters in one program")
    return signatures


def _kept(kernel: str, defines: Mapping[str, int | float | str], match: re.Match[str]) -> str:
    """Return the lines inside a condition if it is true."""
    directive, condition, lines = match.groups()
    if directive == "ifdef":
        return lines if condition in defines else ""
    if condition not in defines:
        raise DeviceError(f"kernel {kernel}: parameters depend on {condition!r}, which is not a define of the build")
    return lines if defines[condition] else ""


def _parse_parameter(kernel: str, text: str, real: Real) -> Parameter:
    words = re.sub(r"\*", " * ", text).replace("__", "").split()
    name, kinds = words[-1], words[:-1]
    if "*" in kinds:
        if "local" in kinds:
            return Parameter(name, "local")
        if "global" in kinds or "constant" in kinds:
            return Parameter(name, "buffer")
    types = [word for word in kinds if word not in ("const", "private")]
    if len(types) == 1:
        dtype = _SCALARS.get(real if types[0] == "real" else types[0])
        if dtype is not None:
            return Parameter(name, "scalar", np.dtype(dtype))
    raise DeviceError(f"kernel {kernel}: parameter {' '.join(text.split())!r} has a type that cannot be bound")
