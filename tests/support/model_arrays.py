"""Random models of any shape, some with dead splats, for the tests of strategies."""

from __future__ import annotations

import numpy as np

from clsplat.splats import shapes
from clsplat.splats.fields import public_shape
from clsplat.splats.shapes import Shape

Arrays = dict[str, np.ndarray]

ALL_SHAPES = [
    shapes.GAUSSIAN,
    shapes.SKEW_NORMAL,
    shapes.SKEW_NORMAL_DIRECT,
    shapes.HALF_GAUSSIAN,
    shapes.BISECTED_SKEW,
    shapes.GENERALISED_EXPONENTIAL,
    shapes.GES_MODULATION,
    shapes.STUDENT_T,
]


def random_model(shape: Shape, n: int, seed: int, dead: float = 0.3, sh_degree: int = 1) -> Arrays:
    """Public float32 arrays. A fraction `dead` of the splats, on average, has opacities below 0.005."""
    rng = np.random.default_rng(seed)
    arrays = {}
    faint = rng.random(n) < dead
    for field in shape.schema(sh_degree):
        values = rng.standard_normal(public_shape(field, n))
        if field.name == "log_scale":
            values -= 3
        elif field.name.startswith("opacity"):
            low = rng.uniform(1e-5, 0.004, n)
            opacity = np.where(faint, low, rng.uniform(0.02, 0.98, n))
            sign = rng.choice([-1, 1], n) if shape.signed else 1
            values = shape.raw_opacity(sign * opacity)
        elif field.bounds is not None:
            values = np.exp(rng.uniform(*np.log(field.bounds), n))
        elif field.limit is not None:
            length = field.limit * rng.random((n, 1))
            values *= 0.98 * length / np.linalg.norm(values, axis=1, keepdims=True)
        arrays[field.name] = values.astype(np.float32)
    return arrays
