"""PSNR and SSIM against their definitions, window by window."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from conftest import MakeRenderer
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.evaluate import evaluate
from clsplat.evaluation.metrics import DEFAULT_PROTOCOL, PROTOCOLS, color_corrected, protocol_named, psnr, ssim
from clsplat.scenes.scene import View
from clsplat.splats.splats import Splats

RNG = np.random.default_rng(5)
A = RNG.random((17, 14, 3))
B = np.clip(A + RNG.normal(0, 0.1, A.shape), 0, 1)
images = arrays(np.uint8, (13, 15, 3))


def ssim_by_windows(a: np.ndarray, b: np.ndarray, padding: str) -> float:
    """SSIM by its definition: weighted moments of every 11x11 window."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    if padding == "zero":
        a, b = (np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (a, b))
    values = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            for c in range(a.shape[2]):
                x, y = a[i : i + 11, j : j + 11, c], b[i : i + 11, j : j + 11, c]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                above = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
                values.append(above / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    return float(np.mean(values))


@pytest.mark.parametrize("padding", ["valid", "zero"])
def test_ssim_is_its_definition(padding: str) -> None:
    assert ssim(A, B, padding, rounded=False) == pytest.approx(ssim_by_windows(A, B, padding), abs=1e-12)


def test_paddings_differ_as_protocols_say() -> None:
    rounded = [np.rint(x * 255) / 255 for x in (A, B)]
    for name, padding in (("clsplat", "valid"), ("3dgs", "zero")):
        measured = protocol_named(name).measure(A, B)
        assert measured["SSIM"] == pytest.approx(ssim_by_windows(*rounded, padding), abs=1e-12)
        assert measured["PSNR"] == pytest.approx(-10 * math.log10(np.mean((rounded[0] - rounded[1]) ** 2)))
    assert "zero padding" in PROTOCOLS["3dgs"].describe()["SSIM"]
    with pytest.raises(InputError, match="clsplat, 3dgs"):
        protocol_named("gsplat")


def test_psnr_of_a_known_error() -> None:
    grey = np.full((4, 5, 3), 0.5)
    assert psnr(grey, grey + 0.1, rounded=False) == pytest.approx(20.0)
    assert psnr(grey, grey) == math.inf
    assert psnr(grey, grey + 0.4 / 255) == psnr(grey, grey + 0.2 / 255)
    assert psnr(np.full((2, 2), 1.0), np.full((2, 2), 7.0), rounded=False) == math.inf  # clipped


@settings(max_examples=40, deadline=None)
@given(a=images, b=images, padding=st.sampled_from(["valid", "zero"]))
def test_laws(a: np.ndarray, b: np.ndarray, padding: str) -> None:
    assert ssim(a, a, padding) == pytest.approx(1.0, abs=1e-12)
    assert ssim(a, b, padding) == pytest.approx(ssim(b, a, padding), abs=1e-12)
    assert ssim(a, b, padding) == pytest.approx(ssim(a[::-1, ::-1], b[::-1, ::-1], padding), abs=1e-9)
    assert -1.0 - 1e-9 <= ssim(a, b, padding) <= 1.0 + 1e-9
    assert psnr(a, b) == psnr(b, a) >= 0.0
    assert psnr(a, b) == pytest.approx(psnr(a / 255.0, b / 255.0, rounded=True))


def test_unusable_images_are_named() -> None:
    with pytest.raises(InputError, match=r"\(17, 14, 3\) and \(16, 14, 3\)"):
        psnr(A, B[:-1])
    with pytest.raises(InputError, match="9x17 px"):
        ssim(A[:, :9], B[:, :9])
    assert 0 < ssim(A[:, :9], B[:, :9], "zero") < 1
    with pytest.raises(InputError, match="reflect"):
        ssim(A, B, "reflect")  # type: ignore[arg-type]


# --- masks and exposures -------------------------------------------------------------------


def test_masked_pixels_are_in_no_metric() -> None:
    """Hidden pixels have no effect: PSNR is that of the other pixels, SSIM that of the windows around them."""
    mask = np.ones(A.shape[:2], bool)
    mask[:, 9:] = False
    wild = np.where(mask[:, :, None], A, RNG.random(A.shape))
    for name in PROTOCOLS:
        measured = [protocol_named(name).measure(a, B, mask) for a in (A, wild)]
        assert measured[0] == measured[1]
        assert measured[0]["PSNR"] == pytest.approx(psnr(A[:, :9], B[:, :9]))
    filled = np.where(mask[:, :, None], A, B)
    by_window = [ssim_by_windows(filled[:, i : i + 11], B[:, i : i + 11], "valid") for i in range(4)]
    assert ssim(A, B, "valid", rounded=False, mask=mask) == pytest.approx(np.mean(by_window), abs=1e-12)


def test_a_mask_that_leaves_no_window_is_no_nan() -> None:
    mask = np.zeros(A.shape[:2], bool)
    mask[0, 0] = True
    assert ssim(A, B, mask=mask) == 1.0


def test_colour_correction_undoes_an_affine_change() -> None:
    matrix = np.array([[0.8, 0.05, 0.0], [0.0, 0.7, 0.1], [0.02, 0.0, 0.9]])
    changed = A @ matrix.T + [0.01, 0.05, 0.0]
    np.testing.assert_allclose(color_corrected(A, changed), changed, atol=1e-12)
    mask = np.zeros(A.shape[:2], bool)
    mask[4:12, 3:11] = True
    np.testing.assert_allclose(color_corrected(A, np.where(mask[:, :, None], changed, 0.5), mask), changed, atol=1e-12)
    with pytest.raises(InputError, match="colour correction"):
        color_corrected(A[:, :, 0], A[:, :, 0])
    protocol = dataclasses.replace(protocol_named("clsplat"), corrected=True)
    assert protocol.measure(A, changed)["PSNR"] > 70
    assert protocol.describe()["name"] == "clsplat, colour-corrected"


def test_evaluate_measures_what_no_mask_hides(devices: list[Device], make_renderer: MakeRenderer) -> None:
    """The hidden half of the photo may hold anything. Without the mask it counts."""
    camera = Camera(24, 20, 20.0, 20.0, 12.0, 10.0, np.eye(4))
    splats = Splats.from_points(np.array([[0.0, 0.0, 3.0]]), np.full((1, 3), 0.6), sh_degree=0)
    renderer, photo = make_renderer(devices[0]), RNG.integers(0, 256, (20, 24, 3)).astype(np.uint8)
    mask = np.broadcast_to(np.arange(24) < 12, (20, 24))
    wild = np.where(mask[:, :, None], photo, 255 - photo)
    views = [View(f"{i}.png", camera, image, mask) for i, image in enumerate((photo, wild))]
    hidden, shown = (
        evaluate(renderer, splats, [dataclasses.replace(view, mask=m) for view in views]).per_view for m in (mask, None)
    )
    render = np.clip(renderer.render(splats, camera).color, 0, 1)
    assert hidden["0.png"]["PSNR"] == hidden["1.png"]["PSNR"] == pytest.approx(psnr(render[:, :12], photo[:, :12]))
    assert hidden["0.png"]["SSIM"] == pytest.approx(ssim(render, photo, mask=mask))
    assert shown["0.png"]["PSNR"] != shown["1.png"]["PSNR"]
    assert shown["0.png"]["PSNR"] == pytest.approx(psnr(render, photo))


def test_evaluate_returns_means_and_finite_values(devices: list[Device], make_renderer: MakeRenderer) -> None:
    """A photo that equals the render has 100 dB in place of infinity."""
    camera = Camera(24, 20, 20.0, 20.0, 12.0, 10.0, np.eye(4))
    splats = Splats.from_points(np.array([[0.0, 0.0, 3.0]]), np.full((1, 3), 0.6), sh_degree=0)
    renderer = make_renderer(devices[0])
    equal = np.rint(255 * np.clip(renderer.render(splats, camera).color, 0, 1)).astype(np.uint8)
    photos = [equal, np.full_like(equal, 128), np.full_like(equal, 130)]
    found = evaluate(renderer, splats, [View(f"{i}.png", camera, photo) for i, photo in enumerate(photos)])
    values = [found.per_view[f"{i}.png"]["PSNR"] for i in range(3)]
    assert values[0] == 100.0
    assert found.psnr == pytest.approx(np.mean(values)) != pytest.approx(np.median(values))
    assert found.corrected_psnr is None


def test_evaluate_also_measures_colour_corrected_renders(devices: list[Device], make_renderer: MakeRenderer) -> None:
    """The photo is the render with half of its brightness."""
    camera = Camera(24, 20, 20.0, 20.0, 12.0, 10.0, np.eye(4))
    splats = Splats.from_points(np.array([[0.0, 0.0, 3.0]]), np.full((1, 3), 0.6), sh_degree=0)
    renderer = make_renderer(devices[0])
    photo = np.rint(127 * np.clip(renderer.render(splats, camera).color, 0, 1)).astype(np.uint8)
    views = [View("0.png", camera, photo)]
    found = evaluate(renderer, splats, views, also_corrected=True)
    assert found.psnr == evaluate(renderer, splats, views).psnr
    corrected = evaluate(renderer, splats, views, protocol=dataclasses.replace(DEFAULT_PROTOCOL, corrected=True))
    assert found.corrected_psnr == corrected.psnr > found.psnr + 10


def test_nothing_differs_where_nothing_counts() -> None:
    a, b, hidden = np.zeros((12, 13, 3)), np.ones((12, 13, 3)), np.zeros((12, 13), bool)
    assert psnr(a, b, mask=hidden) == math.inf
    assert ssim(a, b, mask=hidden) == 1.0
