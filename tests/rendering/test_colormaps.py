"""Pictures of renders: an even colour map, depth over a background, counts of splats, and skew as colour."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import MakeRenderer
from device_schedules import schedule_on
from numpy.typing import NDArray
from reference.scenes import for_shape, random_camera, random_splats, slant_of

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.device.schedule import default_schedule
from clsplat.device.trace import recorded
from clsplat.errors import InputError
from clsplat.rendering.colormaps import (
    FULL_COUNT,
    MODES,
    colour_map,
    count_picture,
    depth_picture,
    depth_range,
    model_for,
    picture,
    picture_of,
    skew_magnitude,
    to_bytes,
)
from clsplat.rendering.renderer import Rendered, Renderer
from clsplat.splats.shapes import SHAPES, SKEW_LIMIT
from clsplat.splats.splats import Splats

BACKGROUND = (0.25, 0.5, 1.0)
WIDTH, HEIGHT = 41, 27  # not a multiple of the tile or block size


def model(shape: str = "skew-normal", n: int = 40) -> Splats:
    return Splats(shape, for_shape(random_splats(3, n, 3, np.float32), shape))


def camera() -> Camera:
    return random_camera(1, WIDTH, HEIGHT)


def one_splat(**fields: object) -> Splats:
    """A large, nearly opaque splat, two units in front of the camera `facing`."""
    arrays = {
        "mean": [[0, 0, 2]],
        "quat": [[1, 0, 0, 0]],
        "log_scale": [[1, 1, -3]],
        "opacity_logit": [9.0],
        "sh": np.zeros((1, 16, 3)),
    } | fields
    return Splats("skew-normal", {name: np.asarray(values, np.float32) for name, values in arrays.items()})


def facing() -> Camera:
    return Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))


def lightness(colours: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return CIELAB L* of sRGB bytes."""
    values = colours / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > 216 / 24389, 116 * np.cbrt(y) - 16, 24389 / 27 * y)


def test_the_colour_map_gets_lighter_evenly() -> None:
    steps = np.diff(lightness(colour_map(np.linspace(0, 1, 33))))
    assert steps.min() > 0.6 * steps.mean()
    assert steps.max() < 1.4 * steps.mean()


def test_the_colour_map_takes_any_number() -> None:
    ends = colour_map(np.array([0.0, 1.0]))
    assert np.array_equal(colour_map(np.array([-3.0, np.nan, -np.inf])), ends[[0, 0, 0]])
    assert np.array_equal(colour_map(np.array([7.0, np.inf])), ends[[1, 1]])
    assert colour_map(np.zeros((4, 5))).shape == (4, 5, 3)


def test_bytes_are_those_of_png_files() -> None:
    assert to_bytes(np.array([-1.0, 0.0, 0.5, 1.0, 2.0, np.nan])).tolist() == [0, 0, 128, 255, 255, 0]


def test_depth_is_a_mean_that_is_blended_over_the_background() -> None:
    alpha = np.array([[1.0, 0.5, 0.0]])
    image = Rendered(np.zeros((1, 3, 3)), alpha, 2.0 * alpha)
    shown = depth_picture(image, (1.0, 4.0), BACKGROUND)
    colour = colour_map(np.array((1 / 2 - 1 / 4) / (1 - 1 / 4)))
    ground = to_bytes(np.array(BACKGROUND))
    assert np.array_equal(shown[0, 0], colour)
    assert np.abs(shown[0, 1] - (colour / 2 + ground / 2)).max() <= 0.51
    assert np.array_equal(shown[0, 2], ground)


def test_stray_depths_do_not_stretch_the_range() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(2.0, 3.0, (50, 50))
    depth[0, :5] = 1e6
    alpha = np.ones_like(depth)
    near, far = depth_range(Rendered(np.zeros((50, 50, 3)), alpha, depth))
    assert 2.0 <= near < far <= 3.0


@pytest.mark.parametrize("depth", [0.0, 5.0, np.nan])
def test_any_render_has_a_depth_picture(depth: float) -> None:
    """Test an empty image, a flat wall, and a pixel that is not finite."""
    for alpha in (0.0, 1.0, -0.2):
        image = Rendered(np.zeros((2, 2, 3)), np.full((2, 2), alpha), np.full((2, 2), depth))
        assert depth_picture(image).shape == (2, 2, 3)


@pytest.mark.parametrize("near_far", [(0.0, 1.0), (2.0, 1.0), (1.0, np.inf), (np.nan, 1.0)])
def test_a_wrong_range_is_refused(near_far: tuple[float, float]) -> None:
    image = Rendered(np.zeros((1, 1, 3)), np.ones((1, 1)), np.ones((1, 1)))
    with pytest.raises(InputError, match="0 < near < far"):
        depth_picture(image, near_far)


def test_counts_rise_by_doublings() -> None:
    counts = np.array([0.0, 1.0, 15.0, FULL_COUNT, 10.0 * FULL_COUNT])
    assert np.array_equal(count_picture(counts), colour_map(np.array([0.0, 1 / 8, 0.5, 1.0, 1.0])))


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_is_a_picture(make_renderer: MakeRenderer, device: Device, mode: str) -> None:
    shown = picture(make_renderer(device), model_for(model(), mode), camera(), mode, BACKGROUND)
    assert shown.shape == (HEIGHT, WIDTH, 3)
    assert shown.dtype == np.uint8
    assert len(np.unique(shown)) > 20


def test_an_unknown_mode_is_refused(make_renderer: MakeRenderer, device: Device) -> None:
    with pytest.raises(InputError, match="choose one of colour, depth"):
        picture(make_renderer(device), model(), camera(), "heat")


@pytest.mark.parametrize("mode", MODES)
def test_no_splats_show_the_background(make_renderer: MakeRenderer, device: Device, mode: str) -> None:
    empty = model().select([])
    shown = picture(make_renderer(device), model_for(empty, mode), camera(), mode, BACKGROUND)
    nothing = {"alpha": np.zeros(3), "splats": colour_map(np.zeros(()))}.get(mode, to_bytes(np.array(BACKGROUND)))
    assert (shown == nothing).all()


def test_colour_and_alpha_are_the_render(make_renderer: MakeRenderer, device: Device) -> None:
    renderer = make_renderer(device)
    image = renderer.render(model(), camera(), BACKGROUND)
    assert np.array_equal(picture(renderer, model(), camera(), background=BACKGROUND), to_bytes(image.color))
    grey = picture_of(image, "alpha")
    assert np.array_equal(grey[..., 0], to_bytes(image.alpha))
    assert (grey == grey[..., :1]).all()


def test_counts_of_blocks_are_the_means_of_their_pixels(make_renderer: MakeRenderer, device: Device) -> None:
    counts = {}
    for name in ("cpu16", "cpu8", "gpu256"):
        renderer = make_renderer(device, schedule=schedule_on(device, name))
        renderer.render(model(), camera())
        counts[name] = renderer.count_splats()
    pixels = counts["gpu256"]
    assert pixels.shape == (HEIGHT, WIDTH)
    assert pixels.max() >= 3
    for name, high in (("cpu16", 4), ("cpu8", 2)):
        for y in range(0, HEIGHT, high):
            for x in range(0, WIDTH, 4):
                block = counts[name][y : y + high, x : x + 4]
                # A pair at the cutoff may or may not be counted.
                assert abs(block - pixels[y : y + high, x : x + 4].mean()).max() <= 2.01 / block.size


def test_counting_needs_a_render(device: Device) -> None:
    with pytest.raises(InputError, match="render an image first"):
        Renderer(device).count_splats()


def test_skew_is_shown_as_a_fraction_of_the_limit(make_renderer: MakeRenderer, device: Device) -> None:
    renderer = make_renderer(device)
    for share in (0.0, 0.5, 0.9):
        skewed = one_splat(skew=[[share * SKEW_LIMIT, 0.0, 0.0]])
        shown = picture(renderer, model_for(skewed, "skew"), facing(), "skew")
        alpha = renderer.render(skewed, facing()).alpha[8, 8]
        assert alpha > 0.4
        expected = alpha * colour_map(np.array(share)).astype(np.float64)
        assert np.abs(shown[8, 8] - expected).max() <= 2.0


def test_both_forms_of_a_skew_have_one_magnitude() -> None:
    shift = np.random.default_rng(2).uniform(-0.4, 0.4, (20, 3))
    arrays = random_splats(0, 20, 0)
    centred = Splats("skew-normal", arrays | {"skew": shift})
    direct = Splats("skew-normal-direct", arrays | {"skew": slant_of(shift)})
    assert np.allclose(skew_magnitude(direct), skew_magnitude(centred), rtol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_has_a_skew(shape: str) -> None:
    magnitude = skew_magnitude(model(shape))
    assert ((magnitude >= 0.0) & (magnitude <= 1.0)).all()
    assert magnitude.any() == (SHAPES[shape].skew_form is not None)


def test_a_lower_degree_is_the_model_without_higher_bands(make_renderer: MakeRenderer, device: Device) -> None:
    renderer = make_renderer(device)
    arrays = model().to_numpy()
    full = renderer.render(model(), camera(), BACKGROUND).color
    low = renderer.render(model(), camera(), BACKGROUND, sh_degree=0).color
    arrays["sh"][:, 1:] = 0.0
    assert np.array_equal(low, renderer.render(Splats("skew-normal", arrays), camera(), BACKGROUND).color)
    assert not np.array_equal(low, full)


def test_models_in_use_stay_on_the_device(device: Device) -> None:
    first, second, third = model(n=30), model(n=40), model(n=50)
    renderer = Renderer(device, schedule=default_schedule(device.info), keep=2)

    def uploads(splats: Splats) -> int:
        with recorded(device) as launches:
            renderer.render(splats, camera())
        return sum(launch.name == "upload" for launch in launches)

    fresh = uploads(first)
    assert uploads(second) == fresh
    again = uploads(first)
    assert again < fresh
    assert uploads(second) == again
    assert uploads(third) == fresh  # `first` is removed
    assert uploads(second) == again
    assert uploads(first) == fresh


def test_faint_pixels_do_not_stretch_the_range_of_depths() -> None:
    """They count if no pixel is solid."""
    alpha = np.where(np.arange(100) < 50, 0.6, 0.2).reshape(10, 10)
    depths = np.where(alpha > 0.5, np.linspace(1, 2, 100).reshape(10, 10), 50.0)
    image = Rendered(np.zeros((10, 10, 3)), alpha, alpha * depths)
    near, far = depth_range(image)
    assert 1 <= near < far < 2
    assert depth_range(Rendered(image.color, np.full_like(alpha, 0.2), 0.2 * depths))[1] == 50
