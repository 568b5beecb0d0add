"""The report: its contents, its size limit, and its wipe and table under mouse, touch and keys."""

from __future__ import annotations

import io
import re
import shutil
from base64 import b64decode
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cli_runner import TEST_NAMES, clsplat, error_of
from PIL import Image

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.report import page as eval_report
from clsplat.evaluation.report.histogram import BINS, histogram, quantile, shares
from clsplat.evaluation.report.images import LONGEST, compare_images, full_scale, map_of, veiled
from clsplat.evaluation.report.page import ModelReport, write_report
from clsplat.models.measurements import ViewRecorder
from clsplat.rendering.colormaps import colour_map
from clsplat.rendering.renderer import Rendered
from clsplat.scenes.scene import View

WIDTH, HEIGHT = 60, 40
URI = re.compile(r'<img ([^>]*)src="data:image/jpeg;base64,([^"]+)"')


def measured(label: str, n: int = 3, error: float = 0.05, mask: bool = False) -> ModelReport:
    """A model whose view `n - 1` is the worst."""
    images, psnr = {}, {}
    for index in range(n):
        photo = np.broadcast_to(np.linspace(60, 190, WIDTH) + 3 * index, (3, HEIGHT, WIDTH)).T.astype(np.uint8)
        photo = np.ascontiguousarray(photo.transpose(1, 0, 2))
        color = photo / np.float32(255) + np.float32(error * (index + 1) / n)
        hides = np.ones((HEIGHT, WIDTH), bool)
        hides[:, :20] = False
        name = f"<{index}>.jpg"
        images[name] = compare_images(photo, color, hides if mask else None)
        psnr[name] = 30.0 - index
    return ModelReport(
        label,
        {"splats": "7"},
        [("shape", "round & flat")],
        {"PSNR": psnr, "SSIM": {name: value / 40 for name, value in psnr.items()}},
        images,
    )


def images(text: str) -> list[tuple[str, np.ndarray]]:
    """Attributes and pixels of all images of a page."""
    return [(attributes, np.asarray(Image.open(io.BytesIO(b64decode(data))))) for attributes, data in URI.findall(text)]


# --- one view ------------------------------------------------------------------------------------


def test_shots_count_whole_images_and_only_what_counts() -> None:
    photo = np.full((900, 1200, 3), 100, np.uint8)
    color = np.full(photo.shape, 103 / 255, np.float32)
    color[:, :600, 0] = 1.5  # brighter than white
    mask = np.ones((900, 1200), bool)
    mask[:450] = False
    shot = compare_images(photo, color, mask)
    assert shot.size == (LONGEST, 600)
    assert {error: n for error, n in enumerate(shot.counts) if n} == {3: 450 * (1200 * 3 - 600), 155: 450 * 600}
    assert shot.hidden is not None
    assert shot.hidden[:300].all()
    assert not shot.hidden[300:].any()
    assert shot.error[400, 100] == round((155 + 3 + 3) / 3)
    assert shot.error[400, 700] == 3


def test_scale_is_round_and_leaves_masked_pixels_out() -> None:
    photo = np.zeros((50, 50, 3), np.uint8)
    color = np.full(photo.shape, 0.15, np.float32)
    color[:25] = 1.0
    mask = np.ones((50, 50), bool)
    mask[:25] = False
    assert full_scale([compare_images(photo, color, mask)]) == 0.2
    assert full_scale([compare_images(photo, color)]) == 1.0
    assert full_scale([compare_images(photo, color, np.zeros((50, 50), bool))]) == 0.02


def test_maps_follow_the_colour_map_and_stripe_what_is_hidden() -> None:
    values = np.array([[0, 51, 102, 255]], np.uint8)
    hidden = np.array([[False, False, False, True]])
    shown = map_of(values, 0.2, hidden)
    assert np.array_equal(shown[0, :3], colour_map(np.array([0.0, 1.0, 1.0])))
    assert len(set(shown[0, 3])) == 1, "grey"
    picture = np.array([[[10, 20, 30], [10, 20, 30], [10, 20, 30], [250, 20, 30]]], np.uint8)
    assert np.array_equal(veiled(picture, hidden)[0, :3], picture[0, :3])
    assert veiled(picture, hidden)[0, 3, 0] < 200


def test_histogram_shares_add_up() -> None:
    counts = np.arange(256)
    assert sum(shares(counts)) == pytest.approx(100.0)
    assert (BINS[0], BINS[-1][1]) == ((0, 0), 255)
    assert all(after[0] == before[1] + 1 for before, after in pairwise(BINS))
    few = np.bincount([0, 0, 1, 200], minlength=256)
    assert (quantile(few, 0.5), quantile(few, 0.75), quantile(few, 0.95)) == (0, 1, 200)
    markup = histogram(["a & b", "c"], [few, counts])
    assert markup.count("<rect") == 2 * len(BINS)
    assert "a &amp; b: 50.0 % differ by 0" in markup
    assert "half of the values are within 0, 95 % within 200 of 255" in markup


# --- the page ------------------------------------------------------------------------------------


def test_a_page_holds_everything_itself(tmp_path: Path) -> None:
    path = write_report(tmp_path / "report.html", [measured("one", mask=True)], "3 test views of yard", ["How."])
    text = path.read_text()
    assert re.findall(r'(?:src|href)="(?!data:|#)', text) == []
    assert "http" not in re.sub(r'base64,[^"]*', "", text)
    assert "&lt;2&gt;.jpg" in text
    assert "<2>" not in text
    assert "round &amp; flat" in text
    rows = re.findall(r'<th scope="row"[^>]*data-value="([^"]*)"', text)
    assert rows == ["&lt;2&gt;.jpg", "&lt;1&gt;.jpg", "&lt;0&gt;.jpg"], "worst first"
    found = images(text)
    assert len(found) == 3 * 3, "render, photo and error of each view"
    assert all('alt="' in attributes and 'alt=""' not in attributes for attributes, _ in found)
    assert all(pixels.shape == (HEIGHT, WIDTH, 3) for _, pixels in found)
    assert "Masked pixels are striped" in text
    assert "hides are left out" in text
    assert text.count('type="range"') == 3
    assert 'href="#view-1"' in text
    assert 'id="view-1"' in text


def test_images_are_what_they_say(tmp_path: Path) -> None:
    model = measured("one", n=1)
    text = write_report(tmp_path / "r.html", [model], "1 view", []).read_text()
    (_, render), (_, photo), (_, error) = images(text)
    shot = model.images["<0>.jpg"]
    assert np.abs(photo.astype(int) - shot.photo).mean() < 2
    assert np.abs(render.astype(int) - shot.render).mean() < 2
    assert full_scale([shot]) == 0.1
    expected = colour_map(np.full((HEIGHT, WIDTH), 13 / 25.5))
    assert np.abs(error.astype(int) - expected).mean() < 6


def test_a_page_of_two_models_compares_them(tmp_path: Path) -> None:
    both = [measured("one"), measured("two", error=0.1)]
    text = write_report(tmp_path / "r.html", both, "3 views", []).read_text()
    assert len(images(text)) == 3 * (2 + 1 + 2), "the photo once"
    assert text.count("<select") == 3 * 2
    assert text.count("<td data-value") == 3 * 2 * 2
    assert text.count("class=best") == 3 * 2 * 2, "equal values are both best"
    other = measured("three", n=2)
    with pytest.raises(InputError, match="three and one were measured on different views"):
        write_report(tmp_path / "s.html", [both[0], other], "views", [])


def test_models_whose_scenes_name_photos_with_and_without_a_folder(tmp_path: Path) -> None:
    """COLMAP names a photo 1.jpg, transforms.json images/1.jpg."""
    one, two = measured("one"), measured("two", error=0.1)
    for rename in (lambda name: f"images/{name}", lambda name: name.replace(".jpg", ".png")):
        other = replace(
            two,
            per_view={metric: {rename(n): v for n, v in values.items()} for metric, values in two.per_view.items()},
            images={rename(name): image for name, image in two.images.items()},
        )
        text = write_report(tmp_path / "r.html", [one, other], "3 views", []).read_text()
        assert text == write_report(tmp_path / "s.html", [one, two], "3 views", []).read_text()


def test_a_page_is_bounded_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = measured("one", n=40)
    whole = write_report(tmp_path / "whole.html", [model], "40 views", []).stat().st_size
    monkeypatch.setattr(eval_report, "IMAGE_BYTES", 0.5 * whole)
    path = write_report(tmp_path / "half.html", [model], "40 views", [])
    assert path.stat().st_size < 0.5 * whole + 20_000, "the rest of the page is small"
    text = path.read_text()
    (shown,) = map(int, re.findall(r"(\d+) of 40 views are shown: the 8 worst", text))
    assert shown == text.count('type="range"')
    titles = [int(number) for number in re.findall(r'<h3 id="[^"]*">&lt;(\d+)', text)]
    assert titles[:8] == list(range(39, 31, -1)), "the worst"
    rest = np.array(sorted(titles[8:]))
    assert np.diff([-1, *rest, 32]).max() <= 5, f"others are spread evenly: {rest}"
    assert text.count('<th scope="row"') == 40, "all are in the table"


# --- clsplat eval --------------------------------------------------------------------------------


def test_eval_writes_the_page(tmp_path: Path, model_folder: Path) -> None:
    model = Path(shutil.copytree(model_folder, tmp_path / "model"))
    (model / "report.html").unlink(missing_ok=True)  # other tests measure the shared model
    said = clsplat("eval", model, "--no-report")
    assert not (model / "report.html").exists()
    assert "page: " not in said
    assert f"page: {model / 'report.html'}" in clsplat("eval", model)
    text = (model / "report.html").read_text()
    assert "2 test views of yard: model" in text
    assert [name in text for name in TEST_NAMES] == [True, True]
    assert all(option in text for option in ("iterations 60,", "cap-max 400,", "sh-degree 1", "seed 0"))
    assert "lambda-dssim" not in text, "a default"
    assert "Protocol clsplat. PSNR: per image, rounded to 8 bits." in text
    other = Path(shutil.copytree(model, tmp_path / "other" / "model"))
    (other / "report.html").unlink()
    clsplat("eval", model, other, "--report", tmp_path / "both.html", "--set", "train")
    both = (tmp_path / "both.html").read_text()
    assert "8 train views of yard: 2 models" in both
    assert str(other) in both, "two folders of one name are told apart"
    assert not (other / "report_train.html").exists()
    assert "not both" in error_of("eval", model, "--report", tmp_path / "x.html", "--no-report", code=2)
    odd = Path(shutil.copytree(model, tmp_path / "not_utf8_\udcff"))
    clsplat("eval", odd)
    assert r"not_utf8_\udcff" in (odd / "report.html").read_text(encoding="utf-8")


def test_a_recorder_sees_renders_in_the_photos_exposure() -> None:
    photo = np.ascontiguousarray(measured("one", n=1).images["<0>.jpg"].photo[..., [0, 0, 0]])
    photo[..., 1] //= 2
    photo[:9, :, 2] = 7
    view = View("a.png", Camera(WIDTH, HEIGHT, 50.0, 50.0, 30.0, 20.0, np.eye(4)), photo)
    dark = Rendered((0.5 * photo / 255).astype(np.float32), np.ones((HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH)))
    plain, corrected = ViewRecorder(), ViewRecorder(corrected=True)
    plain(view, dark)
    corrected(view, dark)
    assert plain.images["a.png"].error.max() > 20
    assert corrected.images["a.png"].error.max() <= 1
    assert np.abs(corrected.images["a.png"].render.astype(int) - photo).max() <= 1


# --- in a browser --------------------------------------------------------------------------------


@pytest.mark.slow
def test_wipe_choice_and_table_in_a_browser(tmp_path: Path) -> None:
    api = pytest.importorskip("playwright.sync_api", reason="playwright: pip install clsplat[test-view]")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium: apt install chromium")
    path = write_report(tmp_path / "r.html", [measured("one"), measured("two")], "3 views", [])
    with api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        context = browser.new_context(viewport={"width": 400, "height": 800}, has_touch=True)
        page = context.new_page()
        complaints: list[str] = []
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 400, "nothing is wider than a telephone"
        wipe, slider = page.locator(".wipe").first, page.locator(".wipe input").first

        def at() -> float:
            return float(wipe.evaluate("one => getComputedStyle(one).getPropertyValue('--at')").rstrip("%"))

        wipe.scroll_into_view_if_needed()
        box = wipe.bounding_box()
        page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 20)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 30, steps=4)
        page.mouse.up()
        assert at() == pytest.approx(80, abs=2)
        page.touchscreen.tap(box["x"] + 0.25 * box["width"], box["y"] + 20)
        assert at() == pytest.approx(25, abs=2)
        slider.focus()
        before = at()
        page.keyboard.press("ArrowRight")
        assert at() > before
        page.keyboard.press("Home")
        assert at() == 0
        figure = page.locator("figure:has(.wipe)").first
        figure.locator("select").nth(1).select_option("1")
        assert figure.locator("img.under").get_attribute("data-key") == "1"
        assert figure.locator("img:visible").count() == 2
        figure.locator("select").nth(1).select_option("0")
        assert figure.locator("img:visible").count() == 1, "the same on both sides"
        page.locator("th button").nth(1).click()
        values = page.locator("table.sortable tbody tr td:nth-child(2)").all_text_contents()
        assert values == sorted(values, key=float)
        page.locator("th button").nth(1).click()
        assert page.locator("table.sortable tbody tr td:nth-child(2)").all_text_contents() == values[::-1]
        assert page.locator("table.sortable th").nth(1).get_attribute("aria-sort") == "descending"
        browser.close()
    assert complaints == []
