"""The numbers that a device's self-test compares with, from the float64 reference.

python tests/support/self_test_numbers.py     # writes clsplat/rendering/self_test.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import numpy as np
from kernel_checks import BACKGROUND, Case
from reference.renderer import prepared, projected_point, reference_gradients

from clsplat.rendering import self_test
from clsplat.splats.near_plane import NEAR_PLANE

DIGITS = 7


def case() -> Case:
    """Return the scene of the self-test with its float32 values."""
    splats = self_test.scene()
    filters = {"antialiased": splats.antialiased, "low_pass": splats.low_pass}
    return Case(splats.to_numpy(), self_test.camera(), splats.shape, **filters)


def numbers() -> self_test.Numbers:
    """Return the numbers; ValueError if a pixel lies at a threshold, where float32 may differ."""
    one = case()
    if self_test.BACKGROUND != BACKGROUND or not one.decided.all():
        raise ValueError(f"{(~one.decided).sum()} pixels at a threshold: change the scene")
    view = one.camera
    z = projected_point(prepared(one.values, one.shape), one.shape) @ view.rotation[2] + view.translation[2]
    image = np.concatenate([one.image.color, one.image.alpha[..., None]], axis=2)
    found = gradients(one)
    shown = np.abs(found["sh"]).sum(1) > 0
    depth = np.where(z < NEAR_PLANE, 0, np.where(shown, z, -z))
    return {"depth": depth, "image": image, **found}


def gradients(one: Case) -> self_test.Numbers:
    v_color = self_test.gradient_of_image()
    found = reference_gradients(
        one.values,
        one.camera,
        v_color,
        None,
        one.shape,
        background=self_test.BACKGROUND,
        antialiased=one.antialiased,
        low_pass=one.low_pass,
    )
    return self_test.summed_bands(found)


def main() -> None:
    rounded = {
        name: np.vectorize(lambda value: float(f"{value:.{DIGITS}g}"))(values).tolist()
        for name, values in numbers().items()
    }
    self_test.NUMBERS.write_text(json.dumps(rounded, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
