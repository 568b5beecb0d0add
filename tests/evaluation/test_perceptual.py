"""LPIPS and FLIP: inputs and outputs of the packages, and the messages if they are missing."""

from __future__ import annotations

import json
import shutil
import sys
import urllib.error
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli_runner import clsplat, error_of

from clsplat.errors import InputError
from clsplat.evaluation.perceptual import VGG_URL, Flip, Lpips

RNG = np.random.default_rng(3)
PHOTO = RNG.integers(0, 256, (40, 48, 3), dtype=np.uint8)
RENDER = np.clip(PHOTO / 255 + RNG.normal(0, 0.1, PHOTO.shape), 0, 1).astype(np.float32)
MASK = np.ones((40, 48), bool)
MASK[:, :10] = False


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[tuple[np.ndarray, np.ndarray]]]:
    """Replace lpips and torch: the net returns the mean square, and its constructor raises `fails`."""

    def install(fails: Exception | None = None, import_fails: Exception | None = None) -> list[Any]:
        seen: list[Any] = []

        def make(net: str, verbose: bool) -> Callable[..., float]:
            assert (net, verbose) == ("vgg", False)
            if fails is not None:
                raise fails

            def measure(a: np.ndarray, b: np.ndarray) -> float:
                seen.append((a, b))
                return float(np.mean((a - b) ** 2))

            return measure

        lpips: Any = SimpleNamespace(LPIPS=make)
        torch = SimpleNamespace(
            from_numpy=lambda array: array,
            inference_mode=nullcontext,
            Tensor=type("Tensor", (), {}),  # SciPy reads this attribute
            hub=SimpleNamespace(get_dir=lambda: str(tmp_path / "hub")),
        )
        monkeypatch.setitem(sys.modules, "lpips", lpips)
        monkeypatch.setitem(sys.modules, "torch", torch)
        if import_fails is not None:
            finder = SimpleNamespace(find_spec=lambda name, *_: _raise(import_fails) if name == "lpips" else None)
            monkeypatch.delitem(sys.modules, "lpips")
            monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
        return seen

    return install


def _raise(error: Exception) -> None:
    raise error


def test_lpips_gets_planes_in_its_range_rounded_to_8_bits(packages: Any) -> None:
    seen = packages()
    value = Lpips()(RENDER, PHOTO)
    ((a, b),) = seen
    assert a.shape == b.shape == (1, 3, 40, 48)
    assert a.dtype == np.float32
    assert (b.min(), b.max()) == (-1.0, 1.0)
    steps = np.rint(RENDER * 255) / 255
    assert np.abs(a - (2 * steps - 1).transpose(2, 0, 1)).max() < 1e-6
    assert value == pytest.approx(4 * np.mean((steps - PHOTO / 255) ** 2), rel=1e-5)
    Lpips(unit_range=True)(RENDER, PHOTO)
    assert (seen[1][1].min(), seen[1][1].max()) == (0.0, 1.0)
    assert "-1..1" in Lpips().describe()
    assert "0..1" in Lpips(unit_range=True).describe().replace("-1..1", "")


def test_hidden_pixels_do_not_differ(packages: Any) -> None:
    seen = packages()
    Lpips()(RENDER, PHOTO, MASK)
    a, b = seen[0]
    assert np.array_equal(a[..., :10], b[..., :10])
    assert not np.array_equal(a[..., 10:], b[..., 10:])


def test_lpips_says_what_is_missing(packages: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    packages()
    with pytest.raises(InputError, match="of 20x40 px; the net needs 32"):
        Lpips()(RENDER[:, :20], PHOTO[:, :20])
    packages(fails=urllib.error.URLError("no route to host"))
    with pytest.raises(InputError) as told:
        Lpips()
    assert "no route to host" in str(told.value)
    assert f"download {VGG_URL} elsewhere and put it into {tmp_path / 'hub' / 'checkpoints'}" in str(told.value)
    weights = tmp_path / "hub" / "checkpoints" / "vgg16-397923af.pth"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"half of it")
    packages(fails=RuntimeError("PytorchStreamReader failed\nfinding central directory"))
    with pytest.raises(InputError, match=r"vgg16-397923af\.pth: .*cannot be read \(PytorchStreamReader failed find"):
        Lpips()
    packages(import_fails=RuntimeError("operator torchvision::nms does not exist"))
    with pytest.raises(InputError, match=r"nms does not exist.*belong together"):
        Lpips()
    packages(import_fails=ImportError("No module named 'lpips'"))
    with pytest.raises(InputError, match=r"No module named 'lpips'.*pip install 'clsplat\[lpips\]'"):
        Lpips()
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[flip\]'"):
        Flip()


def test_eval_has_both_in_files_and_on_the_page(
    packages: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model_folder: Path
) -> None:
    packages()
    model = Path(shutil.copytree(model_folder, tmp_path / "model"))

    def evaluate(reference: np.ndarray, test: np.ndarray, kind: str, **options: bool) -> tuple[Any, float, Any]:
        assert kind == "LDR"
        assert options == {"applyMagma": False, "computeMeanError": False}
        return np.abs(test - reference).mean(axis=2, keepdims=True), -1.0, {}

    monkeypatch.setitem(sys.modules, "flip_evaluator", SimpleNamespace(evaluate=evaluate))
    said = clsplat("eval", model, "--lpips", "--flip", "--compat", "3dgs")
    (entry,) = json.loads((model / "results.json").read_text()).values()
    (per_view,) = json.loads((model / "per_view.json").read_text()).values()
    assert entry["LPIPS"] == pytest.approx(np.mean(list(per_view["LPIPS"].values())))
    assert entry["FLIP"] == pytest.approx(np.mean(list(per_view["FLIP"].values())))
    assert entry["protocol"]["LPIPS"].endswith("inputs 0..1, rounded to 8 bits"), "as 3DGS's script"
    assert [f"{entry[name]:.4f}" in said for name in ("LPIPS", "FLIP")] == [True, True]
    text = (model / "report.html").read_text()
    assert text.count(">FLIP<") == 2 + 2, "in both tables (one of them a button), and under two maps"
    assert "net vgg" in text
    packages(import_fails=ImportError("No module named 'lpips'"))
    assert "pip install 'clsplat[lpips]'" in error_of("eval", model, "--lpips")


def test_real_flip() -> None:
    pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed (pip install clsplat[flip])")
    flip = Flip()
    found = flip(RENDER, PHOTO)
    assert found.shape == (40, 48)
    assert 0.02 < flip.mean(found) < 1
    assert flip.mean(flip(PHOTO, PHOTO)) == 0
    assert flip.mean(flip(RENDER, PHOTO, MASK), MASK) < flip.mean(found, MASK), "hidden errors do not reach out"
    assert flip.mean(found, ~MASK) == pytest.approx(found[:, :10].mean(), rel=1e-5)


def test_real_lpips() -> None:
    try:
        lpips = Lpips()
    except InputError as error:
        pytest.skip(str(error))
    assert lpips(PHOTO, PHOTO) == pytest.approx(0.0, abs=1e-6)
    assert lpips(RENDER, PHOTO) > lpips(0.9 * PHOTO / 255 + 0.1 * RENDER, PHOTO) > 0
