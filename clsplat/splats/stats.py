"""Statistics of a model: splats, fields of the shape in use, SH coefficients by band, bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .formats.ply_compact import bands_in_use, in_use, layout_bytes, movable, plan_layout
from .splats import Splats


@dataclass(frozen=True)
class Complexity:
    """Counts of what a model uses. A parameter is in use if leaving it out would change the splat.

    Parameters
    ----------
    splats : number of splats.
    fields : for each field of the shape (skew, beta, nu), the number of splats whose value is not neutral.
    bands : for each SH band from 0 to the degree of the model, the number of splats whose highest band it is.
    coefficients : for each band, the SH coefficients in use, over all three channels.
    parameters : reals in use. stored : reals in the arrays.
    compact_bytes : bytes of the body of a compact file (see ply_compact.py).
    """

    splats: int
    fields: dict[str, int]
    bands: tuple[int, ...]
    coefficients: tuple[int, ...]
    parameters: int
    stored: int
    compact_bytes: int

    @property
    def skewed(self) -> int:
        """Number of splats with a skew."""
        return self.fields.get("skew", 0)

    @property
    def skewed_fraction(self) -> float:
        """Share of the splats that have a skew; 0 for an empty model."""
        return self.skewed / self.splats if self.splats else 0.0

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as in `clsplat info --json` and results.json."""
        return {
            "splats": self.splats,
            "skewed": self.skewed,
            "skewed_fraction": self.skewed_fraction,
            "fields_in_use": self.fields,
            "splats_by_band": list(self.bands),
            "sh_coefficients": list(self.coefficients),
            "parameters_in_use": self.parameters,
            "parameters": self.stored,
            "compact_bytes": self.compact_bytes,
        }


def complexity(splats: Splats) -> Complexity:
    """Return the statistics of a model."""
    schema, n = splats.schema, len(splats)
    degree = splats.sh_degree
    highest = np.bincount(bands_in_use(splats.sh), minlength=degree + 1)
    # A splat uses every band up to its highest one, because files and kernels have no gaps.
    users = n - np.concatenate([[0], np.cumsum(highest)[:-1]])
    coefficients = tuple(3 * (2 * band + 1) * int(count) for band, count in enumerate(users))
    fields = {field.name: int(np.count_nonzero(in_use(field, splats.arrays[field.name]))) for field in movable(schema)}
    required = sum(field.width for field in schema if field.name != "sh" and field.name not in fields)
    parameters = n * required + sum(coefficients) + sum(schema[name].width * count for name, count in fields.items())
    single = {name: values.astype(np.float32) for name, values in splats.arrays.items()}
    return Complexity(
        n,
        fields,
        tuple(int(count) for count in highest),
        coefficients,
        parameters,
        sum(values.size for values in splats.arrays.values()),
        layout_bytes(schema, plan_layout(schema, single), n),
    )
