"""The columns of the tables: shapes with their parameterisations, and optimizers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from clsplat.splats.shapes import SHAPES
from clsplat.training.optim.skew_map import MAPS


@dataclass(frozen=True)
class Variant:
    """A column of the table: a shape and the map of its skew ("" for shapes without a skew)."""

    shape: str
    skew_map: str = ""

    @property
    def label(self) -> str:
        return f"{self.shape}:{self.skew_map}" if self.skew_map else self.shape

    @property
    def options(self) -> dict[str, Any]:
        """Options of TrainConfig."""
        return {"shape": self.shape} | ({"skew_map": self.skew_map} if self.skew_map else {})


VARIANTS = tuple(
    Variant(shape.name, skew_map)
    for shape in SHAPES.values()
    for skew_map in (MAPS[shape.skew_form] if shape.skew_form else ("",))
)

# How positions move: by Adam with adaptive density control (the default), by Adam with relocation and noise, by SGHMC.
OPTIMIZERS: dict[str, dict[str, Any]] = {
    "adam": {},
    "mcmc": {"strategy": "mcmc", "growth": 1.0},
    "sghmc": {"position_optimizer": "sghmc"},
}
