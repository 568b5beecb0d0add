"""How much of a model is in use: splats, own fields that are not neutral, colour coefficients by band, bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .ply_compact import bands_in_use, in_use, layout_bytes, movable, plan_layout
from .splats import Splats


@dataclass(frozen=True)
class Complexity:
    """What a model is made of. A real parameter counts as in use where leaving it out would change the splat.

    Parameters
    ----------
    splats : their number.
    fields : splats whose value of an own field of the shape (skew, beta, nu) is not the neutral one, by field.
    bands : splats by the highest SH band that is not zero, from 0 to the model's degree.
    coefficients : SH coefficients in use by band, all three channels.
    parameters : reals in use. stored : reals that the arrays hold.
    compact_bytes : of a compact file's body (see ply_compact.py).
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
        """Splats with a skew."""
        return self.fields.get("skew", 0)

    @property
    def skewed_fraction(self) -> float:
        """Of all splats; 0 for a model without any."""
        return self.skewed / self.splats if self.splats else 0.0

    def to_json(self) -> dict[str, Any]:
        """Plain values, as `clsplat info --json` prints them and results.json has them."""
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
    """Count what a model uses."""
    schema, n = splats.schema, len(splats)
    degree = splats.sh_degree
    highest = np.bincount(bands_in_use(splats.sh), minlength=degree + 1)
    # A band counts whole where the splat has it or a higher one: files and kernels know no holes.
    users = n - np.concatenate([[0], np.cumsum(highest)[:-1]])
    coefficients = tuple(3 * (2 * band + 1) * int(count) for band, count in enumerate(users))
    fields = {field.name: int(np.count_nonzero(in_use(field, splats.arrays[field.name]))) for field in movable(schema)}
    always = sum(field.width for field in schema if field.name != "sh" and field.name not in fields)
    parameters = n * always + sum(coefficients) + sum(schema[name].width * count for name, count in fields.items())
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
