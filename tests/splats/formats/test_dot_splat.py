"""Bytes of .splat files, as antimatter15's viewer reads them."""

from __future__ import annotations

import numpy as np

from clsplat.splats.formats.dot_splat import RECORD, records
from clsplat.splats.shapes import GAUSSIAN
from clsplat.splats.stored import StoredSplats


def stored(n: int) -> dict[str, np.ndarray]:
    """Splats of one size and one opacity that look along the axes."""
    return {
        "mean": np.arange(3.0 * n).reshape(n, 3),
        "quat": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "log_scale": np.zeros((n, 3)),
        "opacity_logit": np.zeros(n),
        "sh": np.zeros((n, 1, 3)),
    }


def bytes_of(arrays: dict[str, np.ndarray]) -> np.ndarray:
    single = {name: values.astype(np.float32) for name, values in arrays.items()}
    return records(StoredSplats(GAUSSIAN.name, "peak", False, single))


def test_a_record_is_floats_and_bytes() -> None:
    """A quaternion's component is (byte - 128) / 128, opacity and colour are byte / 255."""
    arrays = stored(1)
    arrays["quat"][:] = (2.0, 2.0, -2.0, 2.0)  # of any norm
    arrays["log_scale"][:] = np.log([0.5, 1.0, 2.0])
    arrays["opacity_logit"][:] = np.log(0.2 / 0.8)
    (record,) = bytes_of(arrays)
    assert RECORD.itemsize == 32
    assert record["position"].tolist() == [0, 1, 2]
    np.testing.assert_allclose(record["scale"], [0.5, 1, 2], rtol=1e-6)
    assert record["colour"].tolist() == [128, 128, 128, 51]
    assert record["quaternion"].tolist() == [192, 192, 64, 192]


def test_what_covers_most_is_first() -> None:
    """Viewers show the start of a file while the rest is loaded."""
    arrays = stored(4)
    arrays["log_scale"][1] = 1.0
    arrays["opacity_logit"][2] = -3.0
    assert (bytes_of(arrays)["position"][:, 0] / 3).tolist() == [1, 0, 3, 2]
