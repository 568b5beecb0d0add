"""The text of a web page (webpage/page.py)."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_arrays import random_model

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.cameras.path import CameraPath
from clsplat.errors import InputError
from clsplat.splats.shapes import GES_MODULATION, SKEW_NORMAL, SKEW_NORMAL_DIRECT, STUDENT_T
from clsplat.splats.splats import Splats
from clsplat.webpage.page import PageContent, as_drawn, page_text, write_web_page

CAMERA = Camera(64, 48, 50.0, 51.0, 30.0, 25.0, np.eye(4))


def splats(n: int = 6) -> Splats:
    return Splats("skew-normal", random_model(SKEW_NORMAL, n, 1))


def settings_of(text: str) -> dict[str, Any]:
    (content,) = re.findall(r'<script id="settings" type="application/json">(.*?)</script>', text, re.S)
    found: dict[str, Any] = json.loads(content)
    return found


def test_names_with_markup_stay_text() -> None:
    name = '</script><script>alert("x")</script> @SCRIPT@ & "more"'
    text = page_text(splats(), PageContent(name, [NamedCamera(name, CAMERA)]))
    assert "<script>alert" not in text
    assert settings_of(text)["cameras"][0]["name"] == name
    assert settings_of(text)["title"] == name
    assert text.count("<script") == 3
    assert "&lt;script&gt;alert(&quot;x&quot;)&lt;/script&gt; @SCRIPT@ &amp;" in text


def test_the_page_needs_no_other_file() -> None:
    text = page_text(splats(), PageContent("scene"))
    assert not re.search(r"""(src|href)=|url\(|import |https?://|fetch\(""", text)


def test_equal_models_give_equal_pages() -> None:
    assert page_text(splats(), PageContent("scene")) == page_text(splats(), PageContent("scene"))


def test_cameras_path_and_background_are_in_the_page() -> None:
    path = CameraPath((CAMERA, CAMERA.posed(np.diag([-1.0, 1.0, -1.0, 1.0]))), fps=12)
    content = PageContent("scene", [NamedCamera("photo", CAMERA)], path, (1.0, 0.5, 0.0))
    found = settings_of(page_text(splats(), content))
    assert found["background"] == [1.0, 0.5, 0.0]
    (camera,) = found["cameras"]
    assert {key: camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")} == {
        "width": 64,
        "height": 48,
        "fx": 50.0,
        "fy": 51.0,
        "cx": 30.0,
        "cy": 25.0,
    }
    assert camera["pose"] == np.eye(4).ravel().tolist()
    assert (len(found["tour"]["cameras"]), found["tour"]["fps"], found["tour"]["closed"]) == (2, 12, False)
    around = settings_of(page_text(splats(), PageContent("scene")))["tour"]
    assert len(around["cameras"]) > 10
    assert around["closed"]


@pytest.mark.parametrize("shape", [GES_MODULATION, SKEW_NORMAL, SKEW_NORMAL_DIRECT], ids=lambda shape: shape.name)
def test_kernels_with_an_equal_are_drawn(shape: Any) -> None:
    arrays = random_model(shape, 5, 0, dead=0)
    if "skew" in arrays:
        arrays["skew"] *= np.float32(0.5)  # longer ones have no equal
    assert as_drawn(Splats(shape.name, arrays)).shape in ("gaussian", "skew-normal")


def test_kernels_without_an_equal_are_refused() -> None:
    with pytest.raises(InputError, match=r"a page draws .* splats, not student-t: .*nu"):
        as_drawn(Splats("student-t", random_model(STUDENT_T, 5, 0, dead=0) | {"opacity_logit": np.ones(5, np.float32)}))


def test_bad_content_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown precision 'half': choose compact or full"):
        write_web_page(tmp_path / "x.html", splats(), PageContent("x"), "half")
    with pytest.raises(InputError, match=r"x\.html: the model has no splats to show"):
        write_web_page(tmp_path / "x.html", splats(0), PageContent("scene"))
    assert not list(tmp_path.iterdir())


def test_splats_that_the_page_draws_smaller_are_counted(tmp_path: Path) -> None:
    """Those that no image shows, and those at the limit, do not count. The full precision keeps all sizes."""
    arrays = random_model(SKEW_NORMAL, 40, 1, dead=0)
    arrays["log_scale"][:] = -3.0
    arrays["opacity_logit"][:5] = [4.0, 4.0, -8.0, 4.0, 4.0]
    arrays["log_scale"][:5] = [[8.0, -3.0, -3.0], [9.0, 9.0, 9.0], [9.0, 9.0, 9.0], [7.0, 7.0, 7.0], [6.0, 7.0, 6.0]]
    some = Splats("skew-normal", arrays)
    with pytest.warns(UserWarning, match="^2 splats are more than 22026 times as large as the median, ") as told:
        write_web_page(tmp_path / "a.html", some, PageContent("scene"))
    assert len(told) == 1
    drawn = Splats.load(tmp_path / "a.html").log_scale[:5].max(axis=1)
    np.testing.assert_allclose(drawn, [7.0, 7.0, 7.0, 7.0, 7.0], atol=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_web_page(tmp_path / "b.html", some, PageContent("scene"), "full")
        write_web_page(tmp_path / "c.html", some.select(np.arange(2, 40)), PageContent("scene"))
    assert Splats.load(tmp_path / "b.html").log_scale[1].max() == 9.0
