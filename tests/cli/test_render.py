"""`clsplat render`: its files equal the images that Python renders."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import (
    HEIGHT,
    ITERATIONS,
    N_VIEWS,
    TEST_NAMES,
    WIDTH,
    clsplat,
    error_of,
    run,
)
from PIL import Image

from clsplat.cameras.cameras_json import read_cameras
from clsplat.errors import InputError
from clsplat.models.cameras import export_cameras
from clsplat.models.evaluation import EvaluationOptions
from clsplat.models.render import ViewChoice
from clsplat.rendering.colormaps import depth_picture
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import load_scene
from clsplat.splats.splats import Splats
from clsplat.training.folder import ModelFolder


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def ply(model: Path, iteration: int = ITERATIONS) -> Path:
    return model / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


# --- render ------------------------------------------------------------------------------------


def test_render_png_of_test_views_with_alpha_and_depth(model: Path, tmp_path: Path) -> None:
    out = clsplat("render", model, "-o", tmp_path / "r", "--alpha", "--depth")
    stems = [Path(name).stem for name in TEST_NAMES]
    assert files(tmp_path / "r") == {f"{stem}{end}.png" for stem in stems for end in ("", "_alpha", "_depth")}
    camera = load_scene(json.loads((model / "config.json").read_text())["scene"]["path"]).test[0].camera
    expected = Renderer().render(Splats.load(ply(model)), camera)
    got = np.asarray(Image.open(tmp_path / "r" / f"{stems[0]}.png"))
    np.testing.assert_array_equal(got, np.rint(255 * np.clip(expected.color, 0, 1)))
    alpha = np.asarray(Image.open(tmp_path / "r" / f"{stems[0]}_alpha.png"))
    np.testing.assert_array_equal(alpha, np.rint(255 * np.clip(expected.alpha, 0, 1)))
    depth = np.asarray(Image.open(tmp_path / "r" / f"{stems[0]}_depth.png")).astype(float)
    line = next(line for line in out.splitlines() if line.startswith(f"{stems[0]}_depth.png"))
    scale = float(line.split(" = ")[1].split()[0]) / 65535
    np.testing.assert_allclose(depth * scale, expected.depth, atol=scale)


def test_render_npy_of_given_cameras_is_the_renderers_image(model: Path, tmp_path: Path) -> None:
    """With only a PLY and --cameras, every camera gives the float32 image that Python gives."""
    clsplat(
        "render",
        ply(model, 40),
        "--cameras",
        model / "cameras.json",
        "-o",
        tmp_path / "r",
        "--format",
        "npy",
        "--alpha",
        "--depth",
        "--background",
        "0.2,0.5,1",
    )
    named = read_cameras(model / "cameras.json")
    stems = [Path(item.name).stem for item in named]
    assert files(tmp_path / "r") == {f"{stem}{end}.npy" for stem in stems for end in ("", "_alpha", "_depth")}
    expected = Renderer().render(Splats.load(ply(model, 40)), named[3].camera, (0.2, 0.5, 1))
    for end, plane in (("", expected.color), ("_alpha", expected.alpha), ("_depth", expected.depth)):
        got = np.load(tmp_path / "r" / f"{stems[3]}{end}.npy")
        assert got.dtype == np.float32
        np.testing.assert_array_equal(got, plane)


def test_given_cameras_are_all_rendered_with_a_model_folder_too(model: Path, tmp_path: Path) -> None:
    clsplat("render", model, "--cameras", model / "cameras.json", "-o", tmp_path / "r", "--iteration", "20")
    assert len(files(tmp_path / "r")) == N_VIEWS


def test_render_sets_and_resolution(model: Path, scene: Path, tmp_path: Path) -> None:
    clsplat("render", model, "-o", tmp_path / "train", "--set", "train")
    assert len(files(tmp_path / "train")) == N_VIEWS - 2
    clsplat("render", "-m", model, "-s", scene, "-r", "2", "-o", tmp_path / "half")
    assert files(tmp_path / "half") == set(TEST_NAMES)
    assert Image.open(tmp_path / "half" / TEST_NAMES[0]).size == (WIDTH // 2, HEIGHT // 2)
    clsplat("render", ply(model), "-s", scene, "-o", tmp_path / "ply")
    assert files(tmp_path / "ply") == set(TEST_NAMES)


def test_sets_without_a_view_are_one_line(model: Path, tmp_path: Path) -> None:
    cameras = json.loads((model / "cameras.json").read_text())
    stems = {Path(name).stem for name in TEST_NAMES}
    tests = [camera for camera in cameras if Path(camera["img_name"]).stem in stems]
    (tmp_path / "tests.json").write_text(json.dumps(tests))
    message = error_of("render", model, "--cameras", tmp_path / "tests.json", "--set", "train", "-o", tmp_path / "r")
    assert message.endswith("tests.json: no training views are known: choose others with --set")


def test_sets_and_formats_that_do_not_exist(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="view_set 'tests': choose one of test, train, validation, all"):
        ViewChoice(view_set="tests")
    with pytest.raises(InputError, match="view_set 'tests': choose one of test, train, validation, all"):
        EvaluationOptions(view_set="tests")
    with pytest.raises(InputError, match="form 'json': choose one of transforms, colmap, colmap-text, cameras"):
        export_cameras(model, tmp_path / "a", "json")


def test_render_orbit_looks_at_the_scene(model: Path, tmp_path: Path) -> None:
    clsplat("render", model, "--path", "orbit", "--frames", "4", "-o", tmp_path / "r")
    assert files(tmp_path / "r") == {"cameras.json", *(f"orbit_{n:03}.png" for n in range(4))}
    cameras = [named.camera for named in read_cameras(tmp_path / "r" / "cameras.json")]
    for camera in cameras:  # the capture's cameras look at (0, 0, 0.5) from a distance of 3.6, with z up
        assert np.hypot(*camera.position[:2]) == pytest.approx(3.6, rel=0.05)
        assert camera.rotation[1] @ [0, 0, 1] < -0.8
    clsplat("render", ply(model), "--path", "orbit", "--frames", "1", "-o", tmp_path / "alone")


@pytest.mark.parametrize("value", ["nan", "inf", "1e300", "1e9", "-1", "0"])
@pytest.mark.parametrize("flag", ["--seconds", "--fps"])
def test_durations_that_no_path_can_have(model: Path, tmp_path: Path, flag: str, value: str) -> None:
    args = ["render", model, "--path", "orbit", "-o", tmp_path / "r", *(["--seconds", "9"] if flag == "--fps" else [])]
    in_range = value in ("inf", "1e300", "1e9") and flag == "--seconds"
    error = error_of(*args, flag, value, code=1 if in_range or value == "nan" else 2)
    assert flag[2:] in error or "more than 100000 frames" in error
    assert not (tmp_path / "r").exists()


def test_a_path_does_not_replace_the_cameras_of_the_model(copied_model: Path) -> None:
    before = ModelFolder(copied_model).cameras_path.read_bytes()
    command = ("render", copied_model, "--path", "orbit", "--frames", 2, "-o", copied_model, "--overwrite")
    assert "is the model itself, whose cameras.json is kept: name another folder" in error_of(*command)
    assert ModelFolder(copied_model).cameras_path.read_bytes() == before
    clsplat("render", copied_model, "-o", copied_model, "-q")


def test_an_image_that_no_memory_holds_is_refused(model: Path, tmp_path: Path) -> None:
    message = error_of("render", model, "-o", tmp_path / "r", "--size", "99999x99999")
    assert "an image of 99999x99999 px needs at least 599988 MB of memory" in message
    assert message.endswith("MB are free: use smaller images (-r 2, 4, 8 or --size WxH)")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("kind", ["ellipse", "spiral"])
def test_render_other_paths(model: Path, tmp_path: Path, kind: str) -> None:
    clsplat("render", model, "--path", kind, "--seconds", "0.1", "-o", tmp_path / "r", "--size", "40x30")
    assert files(tmp_path / "r") == {"cameras.json", *(f"{kind}_{n:03}.png" for n in range(3))}
    assert Image.open(tmp_path / "r" / f"{kind}_000.png").size == (40, 30)


def test_render_between_chosen_cameras_and_along_the_saved_path(model: Path, tmp_path: Path) -> None:
    """Frames at the keys equal the images of those cameras. The path's file gives the same frames or another number."""
    named = {item.name: item.camera for item in read_cameras(model / "cameras.json")}
    clsplat(
        "render",
        model,
        "--path",
        "interpolate",
        "--keys",
        "view_003, view_004.png,view_006",
        "--frames",
        "5",
        "--save-path",
        tmp_path / "path.json",
        "-o",
        tmp_path / "r",
    )
    splats = Splats.load(ply(model))
    for frame, key in (("frame_000", "view_003"), ("frame_004", "view_006")):
        got = np.asarray(Image.open(tmp_path / "r" / f"{frame}.png")).astype(int)
        wanted = 255 * np.clip(Renderer().render(splats, named[key]).color, 0, 1)
        assert np.abs(got - wanted).max() < 1.5
    clsplat("render", ply(model), "--path", tmp_path / "path.json", "-o", tmp_path / "again")
    for index in range(5):
        first, again = (
            np.asarray(Image.open(tmp_path / folder / f"frame_{index:03}.png")).astype(int) for folder in ("r", "again")
        )
        assert np.abs(first - again).max() <= 1
    clsplat("render", ply(model), "--path", tmp_path / "path.json", "--frames", "9", "-o", tmp_path / "more")
    assert len(files(tmp_path / "more")) == 10
    clsplat("render", ply(model), "--path", model / "cameras.json", "-o", tmp_path / "list")
    assert len(files(tmp_path / "list")) == N_VIEWS + 1


def test_coloured_depth_has_one_range_for_the_path(model: Path, tmp_path: Path) -> None:
    clsplat(
        "render",
        model,
        "--path",
        "orbit",
        "--frames",
        "2",
        "-o",
        tmp_path / "r",
        "--depth-colours",
        "--depth-range",
        "1,9",
    )
    camera = read_cameras(tmp_path / "r" / "cameras.json")[1].camera
    wanted = depth_picture(Renderer().render(Splats.load(ply(model)), camera), (1, 9))
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "r" / "orbit_001_depth.png")), wanted)


def test_render_videos_of_colour_depth_and_alpha(model: Path, tmp_path: Path) -> None:
    """The decoded videos have the right number of frames and an even size. Each frame is near the rendered image."""
    imageio = pytest.importorskip("imageio.v2", reason="the extra `video` is not installed")
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    out = clsplat(
        "render",
        model,
        "--path",
        "orbit",
        "--frames",
        "4",
        "--fps",
        "10",
        "--size",
        "49x35",
        "-o",
        tmp_path / "r",
        "--video",
        tmp_path / "v" / "turn.mp4",
        "--depth",
        "--alpha",
    )
    assert "4 frames of 50x36 px, 0.4 s at 10 a second" in out, "the size of the video"
    assert files(tmp_path / "v") == {"turn.mp4", "turn_depth.mp4", "turn_alpha.mp4"}
    for name in ("turn", "turn_depth", "turn_alpha"):
        with imageio.get_reader(tmp_path / "v" / f"{name}.mp4") as reader:
            assert (reader.get_meta_data()["size"], reader.get_meta_data()["fps"]) == ((50, 36), 10)
            frames = list(reader.iter_data())
        assert len(frames) == 4
        if name == "turn":
            for index, frame in enumerate(frames):
                image = np.asarray(Image.open(tmp_path / "r" / f"orbit_{index:03}.png")).astype(int)
                assert np.abs(image - frame[:35, :49]).mean() < 6
    clsplat("render", model, "--path", "orbit", "--frames", "2", "--video", tmp_path / "only.mp4")
    assert (tmp_path / "only.mp4").stat().st_size > 500


def test_frames_that_the_encoder_cannot_write_are_refused_before_the_work(model: Path, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    for size in ("16386x10", "10x16386"):
        said = error_of("render", model, "--path", "orbit", "--size", size, "--video", tmp_path / "v.mp4")
        assert f"frames of {size} px; a video has at most 16384 px a side" in said
    assert not list(tmp_path.iterdir())


def test_an_interrupted_video_says_so_and_leaves_nothing(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    real, calls = Renderer.render, []

    def interrupted(self: Renderer, *args: object) -> object:
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "render", interrupted)
    result = run("render", model, "--path", "orbit", "--frames", "5", "--video", tmp_path / "v.mp4")
    assert result.exit_code == 130
    assert result.stderr.splitlines() == [
        f"{tmp_path / 'v.mp4'}: not written, as the command was stopped at frame 3 of 5",
        "error: interrupted",
    ]
    assert files(tmp_path) == set()


def test_bad_path_flags_and_files(model: Path, tmp_path: Path) -> None:
    out = ["-o", tmp_path / "r"]
    (tmp_path / "p.json").write_text('{"render_width": 20, "render_height": 10, "camera_path": [{"fov": 50}]}')
    message = error_of("render", model, "--path", tmp_path / "p.json", *out)
    assert "p.json: camera_path[0]: key 'camera_to_world' is missing" in message
    assert "no such file; give one, or orbit, ellipse" in error_of("render", model, "--path", "orbti", *out)
    assert "choose --keys from view_000" in error_of("render", model, "--path", "interpolate", "--keys", "x", *out)
    assert "no cameras to interpolate" in error_of("render", ply(model), "--path", "interpolate", *out)
    assert "not both" in error_of("render", model, "--path", "orbit", "--frames", "2", "--seconds", "1", *out, code=2)
    assert "belong to --path interpolate" in error_of("render", model, "--path", "orbit", "--keys", "a", *out, code=2)
    assert "belong to --path" in error_of("render", model, "--frames", "2", *out, code=2)
    assert "-o DIR for images" in error_of("render", model, code=2)
    assert "is not a size" in error_of("render", model, "--path", "orbit", "--size", "0x3", *out, code=2)
    assert "is not a range" in error_of("render", model, "--depth-range", "3,1", *out, code=2)
    refused = error_of("render", model, "--path", "orbit", "--video", tmp_path / "v.avi")
    assert "v.avi: not a supported video format" in refused
    assert files(tmp_path) == {"p.json"}


def test_folders_in_image_names_are_kept(model: Path, tmp_path: Path) -> None:
    entries = json.loads((model / "cameras.json").read_text())[:2]
    entries[0]["img_name"], entries[1]["img_name"] = "left/a.b.JPG", "right/a.b.JPG"
    (tmp_path / "c.json").write_text(json.dumps(entries))
    clsplat("render", model, "--cameras", tmp_path / "c.json", "-o", tmp_path / "r")
    assert files(tmp_path / "r") == {"left/a.b.png", "right/a.b.png"}


def test_plain_3dgs_folders_render(model: Path, tmp_path: Path) -> None:
    """A folder that 3DGS wrote, with cameras.json and a Gaussian PLY, renders."""
    target = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    Splats.load(ply(model)).as_shape("gaussian").save(target)
    header, body = target.read_bytes().split(b"end_header\n", 1)
    plain = b"".join(line + b"\n" for line in header.splitlines() if not line.startswith(b"comment"))
    target.write_bytes(plain + b"end_header\n" + body)
    shutil.copy(model / "cameras.json", tmp_path / "cameras.json")
    clsplat("render", tmp_path, "-o", tmp_path / "r")
    assert len(files(tmp_path / "r")) == N_VIEWS
