"""The splats inside a web page (splats/formats/page_payload.py): what comes back, and damaged pages."""

from __future__ import annotations

import base64
import gzip
import json
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_arrays import random_model

from clsplat.errors import InputError, OutputError
from clsplat.splats.formats.page_payload import pack, read_page, unpack
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import GAUSSIAN, SHAPES, SKEW_NORMAL, STUDENT_T
from clsplat.splats.splats import Splats
from clsplat.splats.stored import StoredSplats
from clsplat.webpage.page import PageContent, write_web_page

BAD_BOUNDS = [("low", [0.0]), ("low", "x"), ("high", [1.0, float("nan"), 1.0]), ("high", [1.0, float("inf"), 1.0])]


def stored(n: int = 40, degree: int = 3, shape: str = "skew-normal", **options: Any) -> StoredSplats:
    arrays = random_model(SHAPES[shape], n, 3, sh_degree=degree)
    return StoredSplats(
        shape, options.pop("normalisation", "peak"), options.pop("antialiased", False), arrays, **options
    )


def page_with(path: Path, payload: bytes) -> Path:
    path.write_text(
        f'<html><script id="payload" type="text/plain">{base64.b64encode(payload).decode()}</script></html>'
    )
    return path


def rewritten(payload: bytes, **changes: Any) -> bytes:
    """Return the payload with other values in its JSON text."""
    whole = gzip.decompress(payload)
    (length,) = struct.unpack("<I", whole[:4])
    text = json.dumps(json.loads(whole[4 : 4 + length]) | changes).encode()
    return gzip.compress(struct.pack("<I", len(text)) + text + whole[4 + length :])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "generalised-exponential"])
def test_full_precision_keeps_what_an_image_depends_on(shape: str, degree: int) -> None:
    before = stored(degree=degree, shape=shape, antialiased=True, near_plane=0.07, low_pass=0.1)
    after = unpack("page", pack(before, "full"))
    assert (after.shape, after.normalisation, after.antialiased) == (shape, "peak", True)
    assert (after.near_plane, after.low_pass) == (0.07, 0.1)
    further = {"skew-normal": ["skew"], "generalised-exponential": ["beta"]}.get(shape, [])
    for name in ("mean", "log_scale", "sh", *further):
        np.testing.assert_array_equal(after.arrays[name], before.arrays[name], err_msg=name)
    turns = [rotations(each.arrays["quat"].astype(np.float64)) for each in (before, after)]
    np.testing.assert_allclose(*turns, atol=1e-6)
    opacities = [GAUSSIAN.opacity(each.arrays["opacity_logit"].astype(np.float64)) for each in (before, after)]
    np.testing.assert_allclose(*opacities, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(1, 30), far=st.floats(1.0, 1e4))
def test_compact_numbers_are_near(seed: int, n: int, far: float) -> None:
    arrays = random_model(SKEW_NORMAL, n, seed, sh_degree=2)
    arrays["mean"] = arrays["mean"] * np.float32(far)
    after = unpack("page", pack(StoredSplats("skew-normal", "peak", False, arrays))).arrays
    middle = np.median(arrays["mean"], axis=0)
    reach = np.abs(arrays["mean"] - middle)
    step = np.log1p(reach.max(axis=0)) / ((1 << 20) - 2) * 2  # of the logarithm
    assert (np.abs(after["mean"] - arrays["mean"]) <= step * (1 + reach) + 1e-6 * (1 + np.abs(arrays["mean"]))).all()
    for name, largest in (("log_scale", 1022), ("skew", 126)):
        spread = np.ptp(arrays[name], axis=0)
        assert (np.abs(after[name] - arrays[name]) <= 0.51 * spread / largest + 1e-5).all(), name
    turns = [rotations(each["quat"].astype(np.float64)) for each in (arrays, after)]
    np.testing.assert_allclose(*turns, atol=0.01)
    top = np.abs(arrays["sh"]).max(axis=0)
    root = np.sqrt(np.abs(arrays["sh"]) / top)
    roots = np.abs(np.sign(after["sh"]) * np.sqrt(np.abs(after["sh"]) / top) - np.sign(arrays["sh"]) * root)
    assert (roots <= 1 / 30 + 1e-3).all()


def test_zeros_stay_zeros_and_unused_bands_are_left_out() -> None:
    arrays = random_model(GAUSSIAN, 50, 0, sh_degree=3)
    arrays["sh"][:, 4:] = 0
    arrays["sh"][7, 1:] = 0
    without = unpack("page", pack(StoredSplats("gaussian", "peak", False, arrays)))
    assert without.arrays["sh"].shape == (50, 4, 3)
    np.testing.assert_array_equal(without.arrays["sh"][7, 1:], 0)


def test_a_flat_splat_does_not_make_the_scales_of_others_coarse() -> None:
    arrays = random_model(GAUSSIAN, 50, 0)
    arrays["log_scale"][3, 1] = -69  # scales of 0 are read as this
    after = unpack("page", pack(StoredSplats("gaussian", "peak", False, arrays))).arrays["log_scale"]
    assert after[3, 1] < arrays["log_scale"][:, 1].max() - 19
    arrays["log_scale"][3, 1] = after[3, 1]
    np.testing.assert_allclose(after, arrays["log_scale"], atol=0.011)


def test_a_stray_splat_does_not_make_the_scales_of_others_coarse() -> None:
    """Runs of other programs that went wrong leave splats of any size."""
    arrays = random_model(GAUSSIAN, 50, 0)
    arrays["log_scale"][3] = 80
    after = unpack("page", pack(StoredSplats("gaussian", "peak", False, arrays))).arrays["log_scale"]
    others = np.arange(50) != 3
    np.testing.assert_allclose(after[others], arrays["log_scale"][others], atol=0.011)
    assert (after[3] > after[others].max(axis=0) + 5).all()


def test_a_skew_normal_without_skew_is_a_gaussian() -> None:
    arrays = random_model(SKEW_NORMAL, 9, 0)
    arrays["skew"][:] = 0
    assert unpack("page", pack(StoredSplats("skew-normal", "peak", False, arrays))).shape == "gaussian"


def test_equal_models_give_equal_bytes_and_compact_is_smaller() -> None:
    model = stored(500)
    assert pack(model) == pack(model)
    assert len(pack(model)) < 0.35 * len(pack(model, "full"))


def test_a_page_is_read_by_its_ending_or_its_content(tmp_path: Path) -> None:
    model = stored(20)
    splats = Splats("skew-normal", model.arrays)
    write_web_page(tmp_path / "scene.html", splats, PageContent("scene"), "full")
    (tmp_path / "renamed").write_bytes((tmp_path / "scene.html").read_bytes())
    for name in ("scene.html", "renamed"):
        np.testing.assert_array_equal(Splats.load(tmp_path / name).mean, splats.mean)
    with pytest.raises(OutputError, match=r"scene.html: pages are written by `clsplat convert`"):
        splats.save(tmp_path / "scene.html")


def test_every_cut_off_payload_is_refused_in_one_line(tmp_path: Path) -> None:
    payload = pack(stored(5))
    for end in range(0, len(payload) - 1, 7):
        with pytest.raises(InputError) as error:
            read_page(page_with(tmp_path / "cut.html", payload[:end]))
        assert "cut.html: its payload cannot be read; the page is damaged or cut off" in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"splats": 4},
        {"splats": -1},
        {"splats": True},
        {"splats": "5"},
        {"splats": 10**12},
        {"columns": {}},
        {"columns": []},
        {"columns": [{"name": "mean"}]},
        {"columns": [{"name": "unknown", "width": 3, "map": "float", "bytes": 4}]},
        {"normalisation": 9},
        {"normalisation": "peak"},
        {"near_plane": -1.0},
        {"near_plane": "near"},
        {"low_pass": 0},
        {"low_pass": [0.1]},
        {"antialiased": []},
    ],
    ids=str,
)
def test_lying_headers_are_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    page = page_with(tmp_path / "lie.html", rewritten(pack(stored(5)), **changes))
    with pytest.raises(InputError, match=r"lie.html: its payload cannot be read"):
        read_page(page)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 4),
        ("bytes", 5),
        ("bytes", -1),
        ("map", "float"),
        ("map", 1),
        ("largest", 0),
        ("largest", 1 << 40),
        *BAD_BOUNDS,
    ],
)
def test_lying_columns_are_refused(tmp_path: Path, name: str, value: Any) -> None:
    payload = pack(stored(5))
    whole = gzip.decompress(payload)
    (length,) = struct.unpack("<I", whole[:4])
    columns = json.loads(whole[4 : 4 + length])["columns"]
    columns[0][name] = value
    with pytest.raises(InputError, match=r"lie.html: its payload cannot be read"):
        read_page(page_with(tmp_path / "lie.html", rewritten(payload, columns=columns)))


def test_a_page_without_positions_is_refused(tmp_path: Path) -> None:
    whole = gzip.decompress(pack(stored(5)))
    (length,) = struct.unpack("<I", whole[:4])
    head = json.loads(whole[4 : 4 + length])
    first = head["columns"].pop(0)
    assert first["name"] == "mean"
    text = json.dumps(head).encode()
    rest = whole[4 + length + 3 * first["bytes"] * 5 :]
    with pytest.raises(InputError, match=r"lie.html: its payload cannot be read"):
        read_page(page_with(tmp_path / "lie.html", gzip.compress(struct.pack("<I", len(text)) + text + rest)))


def test_skews_at_their_limit_stay_within_it() -> None:
    arrays = random_model(SKEW_NORMAL, 300, 5)
    limit = SKEW_NORMAL.schema(0)["skew"].limit
    assert limit is not None
    arrays["skew"] *= (limit / np.linalg.norm(arrays["skew"], axis=1, keepdims=True)).astype(np.float32)
    after = unpack("page", pack(StoredSplats("skew-normal", "peak", False, arrays))).arrays["skew"]
    assert np.linalg.norm(after, axis=1).max() <= limit * (1 + 1e-6)
    np.testing.assert_allclose(after, arrays["skew"], atol=0.02)


def test_a_false_number_of_splats_allocates_nothing(tmp_path: Path) -> None:
    page = page_with(tmp_path / "lie.html", rewritten(pack(stored(5)), splats=10**9))
    tracemalloc.start()
    with pytest.raises(InputError):
        read_page(page)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_values_that_no_model_may_hold_are_left_out_with_a_warning(tmp_path: Path) -> None:
    model = stored(5)
    model.arrays["mean"][2] = np.nan  # type: ignore[index]
    with pytest.warns(UserWarning, match="left out 1 of 5 splats"):
        assert len(read_page(page_with(tmp_path / "nan.html", pack(model, "full"))).arrays["mean"]) == 4


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("<html></html>", "is not a page with splats; choose one that clsplat convert has written"),
        ('<script id="payload" type="text/plain">AAAA', "is not a page with splats"),
        ('<script id="payload" type="text/plain">not base64!</script>', "its payload is not base64"),
        ('<script id="payload" type="text/plain"></script>', "its payload cannot be read"),
    ],
)
def test_other_pages_are_refused(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "other.html").write_text(text)
    with pytest.raises(InputError, match=f"other.html: {what}"):
        Splats.load(tmp_path / "other.html")
    with pytest.raises(InputError, match=r"no.html: cannot be read"):
        Splats.load(tmp_path / "no.html")


def test_other_kernels_are_not_written(tmp_path: Path) -> None:
    splats = Splats("student-t", random_model(STUDENT_T, 4, 0, dead=0))
    with pytest.raises(InputError, match=r"a page draws .* generalised-exponential splats, not student-t"):
        write_web_page(tmp_path / "x.html", splats, PageContent("x"))
    assert not (tmp_path / "x.html").exists()
