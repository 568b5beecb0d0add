"""cameras.json: round trips, 3DGS's conventions, and errors that name entry and key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera, img_names, read_cameras, write_cameras
from clsplat.errors import InputError, OutputError

IN_FOLDER = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
names = st.text(st.characters(codec="utf-8"), min_size=1, max_size=12)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    translation = rng.normal(size=(3, 1)) * 10.0 ** rng.integers(-3, 4)
    pose = np.hstack([Rotation.random(rng=rng).as_matrix(), translation])
    width, height = draw(st.integers(1, 5000)), draw(st.integers(1, 5000))
    fx, fy = rng.uniform(1, 5000, 2)
    return Camera(width, height, fx, fy, rng.uniform(-10, width), rng.uniform(-10, height), pose)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "cameras.json"


def entry(**changes: Any) -> dict[str, Any]:
    """A camera at (1, 2, 3) that looks along world +x: its x axis is world -y, its y axis world -z."""
    base = {
        "id": 0,
        "img_name": "a",
        "width": 40,
        "height": 30,
        "position": [1, 2, 3],
        "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
        "fy": 31,
        "fx": 30.5,
    }
    return {key: value for key, value in (base | changes).items() if value != "absent"}


@IN_FOLDER
@given(named=st.lists(st.tuples(names, cameras()), max_size=4))
def test_round_trip(file: Path, named: list[tuple[str, Camera]]) -> None:
    write_cameras(file, [NamedCamera(name, camera) for name, camera in named])
    read = read_cameras(file)
    assert [item.name for item in read] == [name for name, _ in named]
    for item, (_, camera) in zip(read, named, strict=True):
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(item.camera, key) == getattr(camera, key)
        np.testing.assert_array_equal(item.camera.rotation, camera.rotation)
        size = np.linalg.norm(camera.translation)
        np.testing.assert_allclose(item.camera.translation, camera.translation, rtol=0, atol=1e-13 * size)


def test_3dgs_conventions(file: Path) -> None:
    file.write_text(json.dumps([entry()]))
    (item,) = read_cameras(file)
    camera = item.camera
    assert (item.name, camera.width, camera.height, camera.fx, camera.fy) == ("a", 40, 30, 30.5, 31)
    assert (camera.cx, camera.cy) == (20, 15)
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    ahead = camera.rotation @ np.array([1 + 5.0, 2, 3]) + camera.translation
    np.testing.assert_allclose(ahead, [0, 0, 5], atol=1e-12)
    right = camera.rotation @ np.array([1, 2 - 1.0, 3]) + camera.translation
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)


def test_keys_are_3dgs_and_the_principal_point(file: Path) -> None:
    file.write_text(json.dumps([entry(cx=7, cy=8.5)]))
    (item,) = read_cameras(file)
    assert (item.camera.cx, item.camera.cy) == (7, 8.5)
    write_cameras(file, [item, item])
    written = json.loads(file.read_text())
    assert [one["id"] for one in written] == [0, 1]
    assert written[0] == entry(cx=7, cy=8.5)
    assert ",".join(written[0]) == "id,img_name,width,height,position,rotation,fy,fx,cx,cy"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": "absent"}, "key 'fx' is missing"),
        ({"img_name": "absent"}, "key 'img_name' is missing"),
        ({"img_name": 3}, "'img_name' is a number"),
        ({"img_name": ""}, "'img_name' is the text ''"),
        ({"width": "40"}, "'width' is the text '40'; expected a number"),
        ({"width": True}, "'width' is true"),
        ({"height": 0}, "'height' is 0; expected a whole number"),
        ({"height": 30.5}, "'height' is 30.5; expected a whole number"),
        ({"fy": None}, "'fy' is null"),
        ({"fy": float("nan")}, "'fy' is not finite"),
        ({"fx": 10**400}, "'fx' is not finite"),
        ({"fx": -1}, "focal lengths must be above 0"),
        ({"cx": {}}, "'cx' is an object"),
        ({"position": [1, 2]}, "'position' has the wrong form; expected 3 numbers"),
        ({"position": 1}, "'position' has the wrong form"),
        ({"position": [1, 2, "3"]}, "'position' is the text '3'"),
        ({"rotation": [[1, 0, 0], [0, 1, 0]]}, "'rotation' has the wrong form; expected 3 x 3"),
        ({"rotation": [1, 0, 0]}, "'rotation' has the wrong form"),
        ({"rotation": {}}, "'rotation' has the wrong form"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "'rotation' is not a rotation: it is mirrored"),
        (
            {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]},
            "'rotation' is not a rotation: it is sheared or has different scales",
        ),
    ],
)
def test_faults_name_entry_and_key(file: Path, changes: dict[str, Any], message: str) -> None:
    file.write_text(json.dumps([entry(), entry(**changes)]))
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(file)
    assert str(caught.value).startswith(f"{file}: entry 1")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not JSON"),
        ("[{]", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("\xff", "is not JSON"),
        ('{"frames": []}', "holds an object; expected a list"),
        ("7", "holds a number"),
        ("[[]]", "entry 0: is a list"),
    ],
)
def test_other_files_are_refused(file: Path, text: str, message: str) -> None:
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=message):
        read_cameras(file)


def test_missing_and_unwritable_files(file: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_cameras(file)
    file.write_text("[]")
    assert read_cameras(file) == []
    with pytest.raises(OutputError, match="cannot be written"):
        write_cameras(file / "below", [])


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


@settings(IN_FOLDER, max_examples=100)
@given(key=st.sampled_from(sorted(entry(cx=1, cy=1))), value=json_values)
def test_random_values_are_read_or_refused_with_one_line(file: Path, key: str, value: Any) -> None:
    file.write_text(json.dumps([entry(cx=1, cy=1) | {key: value}]))
    message = str(file)
    try:
        assert len(read_cameras(file)) == 1
    except InputError as error:
        message = str(error)
    assert message.startswith(str(file))
    assert "\n" not in message


def test_image_names_lose_their_extension_unless_two_would_be_equal() -> None:
    assert img_names(["a.jpg", "b.c.PNG", "d", ".png"]) == ["a", "b.c", "d", ".png"]
    assert img_names(["a.jpg", "a.png"]) == ["a.jpg", "a.png"]
