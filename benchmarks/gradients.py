"""Gradient errors of the kernels, per shape and field; one JSON line each.

    python benchmarks/gradients.py [--out benchmarks/results/gradients.jsonl]

Two measures, both relative to the field's gradient in the Euclidean norm:
  differences  double build, thresholds 0, against central finite differences of the rendered image itself, over
               every parameter (random per-pixel weights, non-square image, off-centre principal point)
  reference    float32 build with the usual thresholds, against the exact (complex-step) gradient of the independent
               NumPy renderer in tests/reference/renderer.py
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import common
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(common.ROOT / "tests"))
from reference import reference_gradients
from reference_scenes import random_camera, random_splats

from clsplat.cameras.camera import Camera
from clsplat.rendering.renderer import Renderer
from clsplat.rendering.tuning import schedule_for
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

SEED, N_SPLATS, WIDTH, HEIGHT, STEP = 3, 8, 41, 27, 1e-5
BACKGROUND = (0.2, 0.5, 0.9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=common.RESULTS / "gradients.jsonl")
    parser.add_argument("--device")
    args = parser.parse_args()
    rng = np.random.default_rng(SEED)
    camera = random_camera(SEED, WIDTH, HEIGHT)
    weights = rng.standard_normal((HEIGHT, WIDTH, 3)), rng.standard_normal((HEIGHT, WIDTH))
    args.out.unlink(missing_ok=True)
    print("| shape | field | double against differences | float32 against reference |")
    print("|---|---|---|---|")
    for shape in SHAPES:
        arrays = {
            k: v for k, v in random_splats(SEED, N_SPLATS, 3, np.float64).items() if k in SHAPES[shape].schema(3).names
        }
        smooth = Renderer(args.device, "float64", alpha_min=0.0, alpha_max=1.0, t_min=0.0)
        usual = Renderer(args.device)
        by_differences = differences(smooth, shape, arrays, camera, *weights)
        exact = reference_gradients(arrays, camera, *weights, shape=shape, background=BACKGROUND)
        smooth_grads = gradients(smooth, shape, arrays, camera, *weights)
        usual_grads = gradients(usual, shape, arrays, camera, *weights)
        for field in arrays:
            row = {
                "shape": shape,
                "field": field,
                "double_differences": relative(smooth_grads[field], by_differences[field]),
                "float32_reference": relative(usual_grads[field], exact[field]),
            }
            common.append(args.out, row | common.environment(usual.device, schedule_for(usual.device)))
            print(f"| {shape} | {field} | {row['double_differences']:.1e} | {row['float32_reference']:.1e} |")


def gradients(
    renderer: Renderer,
    shape: str,
    arrays: dict[str, NDArray[np.float64]],
    camera: Camera,
    v_color: NDArray[np.float64],
    v_alpha: NDArray[np.float64],
) -> dict[str, NDArray[np.floating]]:
    """The kernels' own gradient."""
    renderer.render(Splats(shape, arrays), camera, BACKGROUND)
    return renderer.backward(v_color, v_alpha)


def differences(
    renderer: Renderer,
    shape: str,
    arrays: dict[str, NDArray[np.float64]],
    camera: Camera,
    v_color: NDArray[np.float64],
    v_alpha: NDArray[np.float64],
) -> dict[str, NDArray[np.float64]]:
    """Central differences of the weighted image, one parameter at a time."""

    def loss(changed: dict[str, NDArray[np.float64]]) -> float:
        image = renderer.render(Splats(shape, changed), camera, BACKGROUND)
        return float((v_color * image.color).sum() + (v_alpha * image.alpha).sum())

    found = {}
    for field, values in arrays.items():
        slope = np.empty(values.size)
        for i in range(values.size):
            sides = []
            for sign in (1, -1):
                moved = values.copy()
                moved.flat[i] += sign * STEP
                sides.append(loss(arrays | {field: moved}))
            slope[i] = (sides[0] - sides[1]) / (2 * STEP)
        found[field] = slope.reshape(values.shape)
    return found


def relative(got: NDArray[np.floating], want: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


if __name__ == "__main__":
    main()
