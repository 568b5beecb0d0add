"""Path files: nerfstudio's camera_path.json and our cameras.json, written and read, and errors that name the fault."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera, write_cameras
from clsplat.cameras.make_path import PathRequest
from clsplat.cameras.path import CameraPath, path_of, path_text, read_path, write_path
from clsplat.errors import InputError

WIDTH, HEIGHT = 640, 360


def some_cameras(n: int, off_centre: bool = False) -> tuple[Camera, ...]:
    rng = np.random.default_rng(n)
    made = []
    for _ in range(n):
        pose = np.hstack([Rotation.random(rng=rng).as_matrix(), rng.normal(size=(3, 1))])
        fx, fy = rng.uniform(200, 900, 2)
        lens = (fx, fy, 300.0, 200.0) if off_centre else (fx, fx, WIDTH / 2, HEIGHT / 2)
        made.append(Camera(WIDTH, HEIGHT, *lens, pose))
    return tuple(made)


def assert_same(left: Camera, right: Camera) -> None:
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(left, key) == pytest.approx(getattr(right, key), rel=1e-12)
    np.testing.assert_allclose(left.cam_from_world, right.cam_from_world, atol=1e-12)


def nerfstudio(**changes: Any) -> dict[str, Any]:
    """A path of two frames at (1, 2, 3) with OpenGL's axes: the camera looks along -z, and y points up."""
    pose = [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    base = {
        "camera_type": "perspective",
        "render_height": 100,
        "render_width": 200,
        "fps": 24,
        "seconds": 2,
        "camera_path": [{"camera_to_world": pose, "fov": 90, "aspect": 2.0}] * 2,
    }
    return {key: value for key, value in (base | changes).items() if value != "absent"}


@pytest.mark.parametrize("off_centre", [False, True])
def test_round_trip(tmp_path: Path, off_centre: bool) -> None:
    original = CameraPath(some_cameras(5, off_centre), 24.0, some_cameras(2, off_centre), closed=True)
    write_path(tmp_path / "deep" / "path.json", original)
    for read in (read_path(tmp_path / "deep" / "path.json"), path_of(json.loads(path_text(original)), "text")):
        assert (read.fps, read.closed) == (24.0, True)
        for left, right in zip(read.cameras + read.keys, original.cameras + original.keys, strict=True):
            assert_same(left, right)


def test_nerfstudios_axes_and_vertical_field_of_view() -> None:
    path = path_of(nerfstudio(), "test")
    camera = path.cameras[0]
    assert (len(path.cameras), path.fps) == (2, 24)
    assert camera.fx == camera.fy == pytest.approx(50)  # 90 degrees over 100 px
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    ahead_and_up = camera.rotation @ ([1, 2.5, 1] - camera.position)
    np.testing.assert_allclose(ahead_and_up, [0, -0.5, 2])
    written = json.loads(path_text(path))
    assert written["camera_path"][0] == {
        "camera_to_world": nerfstudio()["camera_path"][0]["camera_to_world"],
        "fov": pytest.approx(90),
        "aspect": 2.0,
    }


def test_keyframes_of_both_viewers_of_nerfstudio() -> None:
    pose = np.array(nerfstudio()["camera_path"][0]["camera_to_world"], float).reshape(4, 4)
    new = {"matrix": pose.ravel().tolist(), "fov": 90, "aspect": 2}
    old = {"matrix": json.dumps(pose.T.ravel().tolist()), "fov": 90, "aspect": 2}
    path = path_of(nerfstudio(keyframes=[new, old]), "test")
    for key in path.keys:
        assert_same(key, path.cameras[0])


def test_rate_from_seconds() -> None:
    assert path_of(nerfstudio(fps="absent"), "test").fps == 1
    assert path_of(nerfstudio(fps="absent", seconds="absent"), "test").fps == 30


def test_a_cameras_json_is_a_path(tmp_path: Path) -> None:
    cameras = some_cameras(3, off_centre=True)
    write_cameras(tmp_path / "cameras.json", [NamedCamera(str(n), camera) for n, camera in enumerate(cameras)])
    path = read_path(tmp_path / "cameras.json")
    assert path.seconds == pytest.approx(0.1)
    for left, right in zip(path.cameras, cameras, strict=True):
        assert_same(left, right)


def frame(**changes: Any) -> dict[str, Any]:
    entry = nerfstudio()["camera_path"][0] | changes
    return nerfstudio(
        camera_path=[nerfstudio()["camera_path"][0], {key: value for key, value in entry.items() if value != "absent"}]
    )


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (nerfstudio(camera_path="absent"), ["'camera_path' is missing"]),
        (nerfstudio(render_width="absent"), ["'render_width' is missing"]),
        (nerfstudio(render_height=10.5), ["'render_height'", "10.5"]),
        (nerfstudio(camera_path=[]), ["'camera_path' is empty"]),
        (nerfstudio(camera_path=[3]), ["'camera_path'", "list of objects"]),
        (nerfstudio(camera_type="fisheye"), ["'camera_type'", "fisheye"]),
        (nerfstudio(fps=0), ["fps"]),
        (nerfstudio(fps="absent", seconds=0), ["'seconds' is 0"]),
        (frame(camera_to_world="absent"), ["camera_path[1]", "'camera_to_world' is missing"]),
        (frame(camera_to_world=[1] * 15), ["camera_path[1]", "16 numbers"]),
        (
            frame(camera_to_world=[2, *nerfstudio()["camera_path"][0]["camera_to_world"][1:]]),
            ["camera_path[1]", "rigid"],
        ),
        (frame(fov="absent"), ["camera_path[1]", "'fov' is missing"]),
        (frame(fov=180), ["camera_path[1]", "'fov' is 180"]),
        (frame(fov=math.inf), ["camera_path[1]", "'fov' is not finite"]),
        (nerfstudio(keyframes=[{"matrix": "[1,", "fov": 50}]), ["keyframes[0]", "16 numbers"]),
        (nerfstudio(keyframes=[{"matrix": "[" * 100_000, "fov": 50}]), ["keyframes[0]", "16 numbers"]),
        ([], ["no cameras"]),
        (7, ["a number"]),
    ],
)
def test_errors_name_file_and_field(tmp_path: Path, content: Any, words: list[str]) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        read_path(file)
    message = str(caught.value)
    assert "\n" not in message
    for word in (*words, str(file)):
        assert word in message


def test_a_file_that_is_not_json_and_a_missing_file(tmp_path: Path) -> None:
    (tmp_path / "bad").write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        read_path(tmp_path / "bad")
    (tmp_path / "bytes").write_bytes(b"\xff")
    with pytest.raises(InputError, match="bytes: is not JSON"):
        read_path(tmp_path / "bytes")
    with pytest.raises(InputError, match="cannot be read"):
        read_path(tmp_path / "none")


def test_frames_of_two_sizes_are_refused() -> None:
    first = some_cameras(1)[0]
    with pytest.raises(InputError, match="frame 1 is 64x36"):
        path_text(CameraPath((first, first.resized(64, 36))))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"kind": 5}, "kind is 5; expected orbit, ellipse, spiral, interpolate or a file's name"),
        ({"keys": "ab"}, "keys is the text 'ab'; expected names of cameras in a tuple"),
        ({"keys": (1, 2)}, "keys is a tuple; expected names"),
        ({"frames": "a"}, "frames is the text 'a'; expected a whole number"),
        ({"frames": 2.5}, "frames is 2.5; expected a whole number"),
        ({"frames": 0}, "frames 0: must be at least 1"),
        ({"seconds": "a"}, "seconds is the text 'a'; expected a number"),
        ({"seconds": 0.0}, "seconds 0.0: must be above 0 and finite"),
        ({"fps": [1]}, "fps is a list; expected a number"),
        ({"size": 5}, "size is 5; expected two whole numbers of pixels, (width, height)"),
        ({"size": "40x30"}, "size is the text '40x30'; expected two"),
        ({"size": (40,)}, "size is a tuple; expected two"),
        ({"size": (40, 30.5)}, "size is a tuple; expected two"),
        ({"size": (40, 0)}, "size 40x0: must be at least 1x1"),
    ],
)
def test_a_wrong_value_of_a_request_is_named(values: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as caught:
        PathRequest(**{"kind": "orbit", **values})
    assert str(caught.value).startswith(f"camera path: {said}")


def test_numbers_of_numpy_make_a_request() -> None:
    request = PathRequest("orbit", frames=np.int64(2), fps=np.float32(5), size=(np.int32(4), 3))
    assert request.frame_count(30) == 2
