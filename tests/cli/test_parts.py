"""Parts of the command line: display, names of images, types of options, orbits."""

from __future__ import annotations

import io
import math

import click
import numpy as np
import pytest
from clsplat_cli.options import ColorType, Numbers
from clsplat_cli.path_options import Range
from clsplat_cli.progress import TrainingDisplay, duration, table

from clsplat.cameras.camera import Camera
from clsplat.cameras.orbits import look_at, orbit
from clsplat.errors import InputError
from clsplat.rendering.outputs import output_stems
from clsplat.splats.splats import Splats
from clsplat.training.log import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def at(iteration: int) -> Progress:
    return Progress(iteration, 1000, 0.1234, 20.5, 400, 3.0, 10.0)


def test_a_terminal_gets_one_line_rewritten() -> None:
    stream = Terminal()
    with TrainingDisplay(stream=stream) as display:
        display(Progress(0, 1000, math.nan, math.nan, 0, 0, 0, "400 splats"))
        display(at(250))
        display(at(500))
    first, live, rest = stream.getvalue().split("\n")
    assert first == "400 splats"
    assert rest == ""
    shown = live.split("\r")[1:]
    assert len({len(line) for line in shown}) == 1
    assert len(shown) == 2
    for part in ("500/1000", "loss 0.1234", "PSNR 20.50", "400 splats", "10 it/s", "50 s left", "#"):
        assert part in shown[1]


def test_a_file_gets_a_line_every_ten_seconds_and_the_last() -> None:
    stream, now = io.StringIO(), [0.0]
    display = TrainingDisplay(stream=stream, clock=lambda: now[0])
    for now[0], iteration in ((0.0, 50), (5.0, 100), (11.0, 150), (12.0, 1000)):
        display(at(iteration))
    assert [line.split("/")[0] for line in stream.getvalue().splitlines()] == ["50", "150", "1000"]


def test_quiet_shows_nothing() -> None:
    stream = Terminal()
    with TrainingDisplay(quiet=True, stream=stream) as display:
        display(at(50))
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "text"), [(7.4, "7 s"), (59.6, "1:00"), (151, "2:31"), (3751, "1:02:31"), (math.inf, "?")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_table_columns_line_up() -> None:
    assert table(("name", "n"), [("a", "10"), ("long name", "5")]) == "name        n\na          10\nlong name   5"


def test_stems() -> None:
    names = ["a.JPG", "dir/b.png", "./c.0001", "d.e.webp", "dir//f"]
    assert output_stems(names) == ["a", "dir/b", "c.0001", "d.e", "dir/f"]
    assert output_stems(["a", "a_alpha"]) == ["a", "a_alpha"]
    assert output_stems(["a.jpg", "./b//c.png"], keep_suffix=True) == ["a.jpg", "b/c.png"]
    for bad in (["x/../y"], ["/x"], [""], ["."], ["a\0"], ["a", "a.png"]):
        with pytest.raises(InputError):
            output_stems(bad)


def test_option_types() -> None:
    assert ColorType().convert("0, .5,1", None, None) == (0, 0.5, 1)
    assert Numbers().convert("1000, 7000 30000", None, None) == (1000, 7000, 30000)
    for kind, bad in ((ColorType(), "1,1,1,1"), (ColorType(), "-1,0,0"), (Numbers(), "0"), (Numbers(), "")):
        with pytest.raises(click.BadParameter):
            kind.convert(bad, None, None)


# --- orbits ----------------------------------------------------------------------------------


def cloud() -> Splats:
    rng = np.random.default_rng(0)
    return Splats.from_points(rng.normal((2, -1, 3), 1.0, (200, 3)), rng.random((200, 3)), sh_degree=0)


def facing(position: list[float], target: list[float], up: list[float]) -> Camera:
    pose = look_at(np.array(position), np.array(target), np.array(up))
    return Camera(60, 40, 50, 50, 30, 20, pose)


def middle_px(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = camera.rotation @ point + camera.translation
    assert z > 0
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def test_look_at() -> None:
    camera = facing([3, 1, 2], [0, 0, 0], [0, 0, 1])
    np.testing.assert_allclose(camera.position, [3, 1, 2], atol=1e-12)
    np.testing.assert_allclose(middle_px(camera, np.zeros(3)), [30, 20], atol=1e-9)
    above = middle_px(camera, np.array([0, 0, 0.1]))
    assert above[0] == pytest.approx(30)
    assert above[1] < 20
    assert np.linalg.det(camera.rotation) == pytest.approx(1)


def test_orbit_of_a_half_ring_closes_it() -> None:
    """The cameras are on half a ring around (1, 2, 0.5), with z up. The orbit is the whole ring."""
    target, angles = np.array([1.0, 2.0, 0.5]), np.linspace(0, np.pi, 7)
    ring = [facing([1 + 4 * math.cos(a), 2 + 4 * math.sin(a), 1.5], [1, 2, 0.5], [0, 0, 1]) for a in angles]
    made = orbit(cloud(), ring, 12)
    assert len(made) == 12
    for camera in made:
        np.testing.assert_allclose(middle_px(camera, target), [30, 20], atol=1e-6)
        assert camera.position[2] == pytest.approx(1.5, abs=0.05)
        assert np.linalg.norm(camera.position - target) == pytest.approx(math.hypot(4, 1), rel=0.02)
        assert (camera.width, camera.fx) == (60, 50)
    places = np.array([camera.position for camera in made])
    np.testing.assert_allclose(places.mean(axis=0)[:2], target[:2], atol=0.5)


def test_orbit_of_parallel_cameras_turns_about_the_splats_depth() -> None:
    row = [facing([x, 0, 0], [x, 0, 1], [0, -1, 0]) for x in (-0.2, 0.0, 0.2)]
    depth = float(np.median(cloud().mean[:, 2]))
    for camera in orbit(cloud(), row, 3):
        np.testing.assert_allclose(middle_px(camera, np.array([0, 0, depth])), [30, 20], atol=1e-3)


def test_orbit_without_cameras_sees_the_splats() -> None:
    splats = cloud()
    for camera in orbit(splats, (), 5):
        local = splats.mean @ camera.rotation.T + camera.translation
        assert (local[:, 2] > 0).all()
        pixels = local[:, :2] / local[:, 2:] * camera.fx + (camera.cx, camera.cy)
        inside = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        assert inside.mean() > 0.8
    assert len(orbit(splats.select([0]), (), 2)) == 2  # one splat has no extent
    with pytest.raises(InputError):
        orbit(splats.select([]), (), 2)


@pytest.mark.parametrize("text", ["-1,2", "0,2", "2,1", "1,1", "1,inf", "nan,2", "1"])
def test_a_range_of_depths_is_in_front_of_the_camera(text: str) -> None:
    assert Range().convert("0.5,20", None, None) == (0.5, 20)
    with pytest.raises(click.BadParameter, match="is not a range"):
        Range().convert(text, None, None)
