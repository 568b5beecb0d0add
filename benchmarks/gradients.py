"""Gradient errors of the kernels, per shape and field; one JSON line each.

    python benchmarks/gradients.py [--out benchmarks/results/gradients.jsonl]

Two measures, both relative to the field's gradient in the Euclidean norm:

- differences: the double build with thresholds 0, against central finite differences over every parameter. The loss is
  a random weighting of a non-square image with an off-centre principal point.
- reference: the float32 build with the usual thresholds, against the exact (complex-step) gradient of the independent
  NumPy renderer in tests/reference/renderer.py.
"""

from __future__ import annotations

import sys

import common
import numpy as np
from numpy.typing import NDArray

sys.path.extend(common.TEST_HELPERS)
from kernel_checks import SMOOTH, Case, differences
from reference.scenes import random_camera, random_splats

from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.shapes import SHAPES

SEED, N_SPLATS, WIDTH, HEIGHT = 3, 8, 41, 27


def main() -> None:
    parser = common.parser(__doc__, common.RESULTS / "gradients.jsonl", smoke=False)
    args = parser.parse_args()
    if not args.table:
        args.out.unlink(missing_ok=True)
        smooth, usual = Renderer(args.device, "float64", **SMOOTH), Renderer(args.device)
        environment = common.environment(usual.device, schedule_for(usual.device))
        for shape in SHAPES:
            for row in errors(shape, smooth, usual):
                common.append(args.out, row | environment)
    rows = [
        (row["shape"], row["field"], f"{row['double_differences']:.1e}", f"{row['float32_reference']:.1e}")
        for row in common.read(args.out)
    ]
    print(common.table(["shape", "field", "double against differences", "float32 against reference"], rows))


def errors(shape: str, smooth: Renderer, usual: Renderer) -> list[dict[str, object]]:
    """Return a row for each field of a shape: the errors of both builds."""
    camera, arrays = random_camera(SEED, WIDTH, HEIGHT), random_splats(SEED, N_SPLATS, 3, np.float64)
    double = Case(arrays, camera, shape, dtype=np.float64, seed=SEED, thresholds=SMOOTH)
    single = Case(arrays, camera, shape, seed=SEED)
    double.render(smooth)
    smooth_gradients = double.backward(smooth)
    single.render(usual)
    usual_gradients = single.backward(usual)
    return [
        {
            "shape": shape,
            "field": field,
            "double_differences": relative(smooth_gradients[field], differences(smooth, double, field)),
            "float32_reference": relative(usual_gradients[field], single.gradients[field]),
        }
        for field in double.values
    ]


def relative(value: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Return the norm of the difference over the norm of the reference."""
    return float(np.linalg.norm(value - reference) / np.linalg.norm(reference))


if __name__ == "__main__":
    main()
