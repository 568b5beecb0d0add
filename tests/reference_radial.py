"""The reference's kernels that depend on q alone, with a learned falloff."""

from __future__ import annotations

from reference_shape import ShapeReference

RADIAL: dict[str, ShapeReference] = {}
