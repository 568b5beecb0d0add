"""Reconstruction from photos: correct poses, complete scenes or none, and one-line errors."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import clsplat_cli.reconstruct as cli
import numpy as np
import photo_walk
import pytest
from cli_runner import clsplat, error_of, run
from PIL import Image

from clsplat.errors import InputError, OutputError
from clsplat.scenes.colmap import find_model, read_model
from clsplat.scenes.reconstruct import reconstruct as module
from clsplat.scenes.reconstruct.model_scene import plan_scene
from clsplat.scenes.reconstruct.options import CAMERA_MODELS, CAMERA_MODES, MATCHERS, ReconstructOptions
from clsplat.scenes.reconstruct.pairs import pairs_of
from clsplat.scenes.reconstruct.photo_files import PhotoFile, find_photos
from clsplat.scenes.reconstruct.reconstruct import is_made_from, reconstruct
from clsplat.scenes.reconstruct.sfm_process import Step
from clsplat.scenes.scene import Scene, load_scene

_kept: dict[str, Path] = {}


@pytest.fixture
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos, one of them with a mask; made once, read only."""
    if "walk" not in _kept:
        folder = photo_walk.write_walk(tmp_path_factory.mktemp("photos") / "walk")
        hidden = np.full((photo_walk.HEIGHT, photo_walk.WIDTH), 255, np.uint8)
        hidden[:, :80] = 0
        (folder / "masks").mkdir()
        Image.fromarray(hidden).save(folder / "masks" / "walk_03.png")
        (folder / "note.png").write_bytes(b"no photo")
        _kept["walk"] = folder
    return _kept["walk"]


@pytest.fixture
def scene(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walk reconstructed by the command line; made once, read only."""
    if "scene" not in _kept:
        folder = tmp_path_factory.mktemp("scenes") / "corner"
        result = run("reconstruct", walk, "-o", folder)
        assert result.exit_code == 0, result.output
        assert "warning: left out: " in result.stderr
        assert "note.png" in result.stderr
        assert "pairs matched 28/28" in result.stderr
        assert "8 of 8 photos placed" in result.stdout
        assert [left.name for left in folder.parent.iterdir()] == ["corner"], "nothing unfinished stays"
        _kept["scene"] = folder
    return _kept["scene"]


def aligned_error(scene: Scene) -> tuple[float, float]:
    """Return the largest errors of camera centres [share of their spread] and viewing directions [degrees].

    Errors are measured after the similarity transform that aligns the centres with the true ones (Umeyama 1991).
    """
    poses = np.array([photo_walk.cam_from_world(int(name[5:7])) for name in scene.names])
    true = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    centres = np.array([view.camera.position for view in scene.views])
    a, b = centres - centres.mean(axis=0), true - true.mean(axis=0)
    u, sizes, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ sign @ vt
    scale = (sizes * np.diag(sign)).sum() / (a**2).sum()
    spread = np.linalg.norm(b, axis=1).max()
    off = np.linalg.norm(scale * a @ turn.T - b, axis=1).max() / spread
    angles = [
        np.degrees(np.arccos(np.clip((turn @ view.camera.rotation[2]) @ pose[2, :3], -1, 1)))
        for view, pose in zip(scene.views, poses, strict=True)
    ]
    return float(off), float(max(angles))


def test_poses_are_the_true_ones(scene: Path) -> None:
    loaded = load_scene(scene, eval=False)
    assert loaded.names == photo_walk.names()
    off, angle = aligned_error(loaded)
    assert off < 0.01
    assert angle < 0.5
    camera = loaded.views[0].camera
    assert camera.fx == pytest.approx(photo_walk.FOCAL, rel=0.05)
    assert abs(camera.width - photo_walk.WIDTH) <= 8
    assert len({view.camera.fx for view in loaded.views}) == 1, "photos of one size share a lens"


def test_points_project_to_their_observations(scene: Path) -> None:
    """The test projects the points with NumPy and compares the written observations."""
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.num_points3D() > 200
    distances = []
    for image in model.images.values():
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        assert camera.model.name == "PINHOLE"
        for point in image.get_observation_points2D():
            seen = pose[:, :3] @ model.points3D[point.point3D_id].xyz + pose[:, 3]
            fx, fy, cx, cy = camera.params
            distances.append(np.hypot(*(seen[:2] / seen[2] * (fx, fy) + (cx, cy) - point.xy)))
    assert np.mean(distances) < 0.5
    assert model.compute_mean_track_length() > 3
    record = json.loads((scene / "reconstruct.json").read_text())
    assert record["registered"] == record["photos"] == 8
    assert record["points"] == model.num_points3D()


def test_the_mask_is_undistorted_with_its_photo(scene: Path) -> None:
    mask = np.array(Image.open(scene / "masks" / "walk_03.png.png"))
    assert mask[10:-10, 10:70].max() == 0
    assert mask[10:-10, 90:-10].min() == 255
    view = next(view for view in load_scene(scene, eval=False).views if view.name == "walk_03.png")
    assert view.mask is not None
    assert not view.mask[:, 10:70].any()
    points = read_model(find_model(scene))
    assert len(points.points) > 0


def test_a_scene_is_not_replaced_without_overwrite(scene: Path, walk: Path, tmp_path: Path) -> None:
    assert "already holds a scene: use --overwrite" in error_of("reconstruct", walk, "-o", scene)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work.txt").write_text("hours")
    with pytest.raises(OutputError, match="is not a reconstructed scene"):
        reconstruct(walk, tmp_path / "mine", overwrite=True)
    assert is_made_from(scene, walk)
    assert is_made_from(tmp_path, walk) is None


@pytest.mark.parametrize("killed", [False, True])
def test_an_old_scene_stays_until_the_new_one_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    """A full disk, or the end of the process, comes between the two moves."""
    scene, new = tmp_path / "scene", tmp_path / ".scene.unfinished" / "scene"
    for folder in (scene, new):
        folder.mkdir(parents=True)
        (folder / "reconstruct.json").write_text(folder.parent.name)
    moves = []

    def fails(source: Path, target: Path) -> None:
        moves.append(target)
        if source == new:
            raise OSError("no space")
        if killed and source != scene:
            raise OSError("killed before")
        source.replace(target)

    monkeypatch.setattr(module, "move", fails)
    with pytest.raises(OSError, match="killed before" if killed else "no space"):
        module._move_into_place(new, scene)
    assert scene.exists() is not killed
    monkeypatch.undo()
    module._finish_killed(scene)
    assert (scene / "reconstruct.json").read_text() == tmp_path.name
    module._move_into_place(new, scene)
    assert (scene / "reconstruct.json").read_text() == ".scene.unfinished"
    assert [path.name for path in tmp_path.iterdir() if "old" in path.name] == []


TINY = ("--eval", "--iterations", 10, "--cap-max", 300, "--sh-degree", 0)


def test_training_on_photos_reuses_the_scene(scene: Path, walk: Path, tmp_path: Path) -> None:
    """The scene lies in the model's folder, moves with it, and is not used for other photos."""
    photos = Path(shutil.copytree(walk, tmp_path / "walk"))
    shutil.copytree(scene, tmp_path / "model" / "scene")
    result = run("train", photos, "-m", tmp_path / "model", *TINY)
    assert result.exit_code == 0, result.output
    assert f"no poses: {tmp_path / 'model' / 'scene'} was reconstructed from it before" in result.stderr
    assert "test views (1)" in result.stdout
    (tmp_path / "model").rename(tmp_path / "moved")
    assert "resumed at iteration 10" in run("train", photos, "-m", tmp_path / "moved", "--resume").stderr
    clsplat("eval", tmp_path / "moved", "--no-report")
    Image.fromarray(255 - photo_walk.picture(0)).save(photos / "walk_00.png")
    assert "was reconstructed from other photos" in error_of("train", photos, "-m", tmp_path / "moved", "--resume")
    shutil.copytree(scene, tmp_path / "other" / "scene")
    message = error_of("train", photos, "-m", tmp_path / "other", *TINY)
    assert "other/scene: was reconstructed from other photos" in message
    assert "use --overwrite" in message


def test_folders_of_one_name_have_a_scene_each(scene: Path, walk: Path, tmp_path: Path) -> None:
    """The second folder of photos is called as the first. Its model leaves the first model's scene alone."""
    for name in ("a", "b"):
        shutil.copytree(walk, tmp_path / name / "images")
    (tmp_path / "b" / "images" / "walk_07.png").unlink()
    for name in ("a", "b"):
        planned = plan_scene(tmp_path / name / "images", tmp_path / "out" / name)
        assert (planned.path, planned.exists) == (tmp_path / "out" / name / "scene", False)
        shutil.copytree(scene, planned.path)
    assert plan_scene(tmp_path / "a" / "images", tmp_path / "out" / "a").exists
    with pytest.raises(OutputError, match=r"out/b/scene: was reconstructed from other photos than .*b/images now has"):
        plan_scene(tmp_path / "b" / "images", tmp_path / "out" / "b")
    replaced = plan_scene(tmp_path / "b" / "images", tmp_path / "out" / "b", overwrite=True)
    assert (replaced.path, replaced.exists) == (tmp_path / "out" / "b" / "scene", False)


def test_a_model_whose_scene_lies_beside_it(scene: Path, walk: Path, tmp_path: Path) -> None:
    """Models of earlier versions record such a scene, and the scene records no contents of its photos."""
    shutil.copytree(scene, tmp_path / "walk-scene")
    record = json.loads((scene / "reconstruct.json").read_text())
    digest = record.pop("photo_digest")
    (tmp_path / "walk-scene" / "reconstruct.json").write_text(json.dumps(record | {"fingerprint": digest}))
    clsplat("train", tmp_path / "walk-scene", "-m", tmp_path / "model", *TINY)
    assert "resumed at iteration 10" in run("train", walk, "-m", tmp_path / "model", "--resume").stderr
    clsplat("eval", tmp_path / "model", "--no-report")
    (tmp_path / "walk-scene" / "reconstruct.json").unlink()
    message = error_of("train", walk, "-m", tmp_path / "model", "--resume")
    assert f"was trained on {tmp_path / 'walk-scene'}, not on photographs" in message


def test_a_scene_and_a_model_inside_the_photos(walk: Path, scene: Path, tmp_path: Path) -> None:
    photos = Path(shutil.copytree(walk, tmp_path / "walk"))
    shutil.copytree(scene, photos / "model" / "scene")
    shutil.copytree(scene, photos / "scene")
    clsplat("train", photos, "-m", photos / "model", *TINY)
    clsplat("render", photos / "model", "-o", photos / "renders", "-q")
    assert len(find_photos(photos)) == 9, "eight photos and the file that is none"
    result = run("train", photos, "-m", photos / "model", *TINY, "--overwrite")
    assert result.exit_code == 0, result.output
    assert "was reconstructed from it before" in result.stderr
    photos_read = [photo.name for photo in find_photos(photos)]
    assert [name for name in photos_read if "/" in name] == []
    (tmp_path / "work").mkdir()
    with pytest.warns(UserWarning, match=r"left out: model, scene, 1 render in .*walk: scenes, models and renders"):
        module._stage_all(find_photos(photos), photos, tmp_path / "work", lambda step: None)


def test_too_few_photos(tmp_path: Path) -> None:
    photo_walk.write_walk(tmp_path / "two", 2)
    assert "2 photos that can be used; at least 3" in error_of("reconstruct", tmp_path / "two", "-o", tmp_path / "s")
    assert "no such folder" in error_of("reconstruct", tmp_path / "none", "-o", tmp_path / "s")
    assert [entry.name for entry in tmp_path.iterdir()] == ["two"]


def test_photos_that_do_not_fit_together(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "noise").mkdir()
    for index in range(3):
        Image.fromarray(rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)).save(tmp_path / "noise" / f"{index}.png")
    with pytest.raises(InputError, match=r"no two photos fit together.*with texture$"):
        reconstruct(tmp_path / "noise", tmp_path / "scene")
    assert [entry.name for entry in tmp_path.iterdir()] == ["noise"]


@pytest.mark.filterwarnings("ignore:left out")
def test_masks_that_hide_too_much_are_named(tmp_path: Path) -> None:
    photos = photo_walk.write_walk(tmp_path / "walk", 3)
    (photos / "masks").mkdir()
    hidden = np.zeros((photo_walk.HEIGHT, photo_walk.WIDTH), np.uint8)
    for name in photo_walk.names(3):
        Image.fromarray(hidden).save(photos / "masks" / name)
    message = error_of("reconstruct", photos, "-o", tmp_path / "scene")
    assert "0 photos that can be used; at least 3 are needed" in message
    assert f"walk_00.png: its mask {photos / 'masks' / 'walk_00.png'} hides every pixel" in message
    hidden[:9, :9] = 255
    for name in photo_walk.names(3):
        Image.fromarray(hidden).save(photos / "masks" / name)
    message = error_of("reconstruct", photos, "-o", tmp_path / "scene")
    assert "no two photos fit together" in message
    assert f"look at the masks in {photos / 'masks'}: black hides" in message


def test_a_crash_of_pycolmap_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One child process dies by a signal, another ends without a result."""
    photo_walk.write_walk(tmp_path / "walk", 3)
    start = subprocess.Popen
    programs = {
        "signal SIGABRT": "import os; os.abort()",
        "exit code 3: out of luck": "import sys; print('out of luck', file=sys.stderr); sys.exit(3)",
    }
    for reason, program in programs.items():
        monkeypatch.setattr(
            "clsplat.scenes.reconstruct.sfm_process.subprocess.Popen",
            lambda command, program=program, **options: start([sys.executable, "-c", program], **options),
        )
        with pytest.raises(InputError, match=rf"structure from motion failed \({reason}"):
            reconstruct(tmp_path / "walk", tmp_path / "scene")
        assert [entry.name for entry in tmp_path.iterdir()] == ["walk"]


def test_leftovers_of_a_killed_run_are_removed_and_a_second_run_is_refused(tmp_path: Path) -> None:
    left = tmp_path / ".scene.unfinished"
    (left / "photos").mkdir(parents=True)
    (left / "database.db").write_bytes(b"half")
    with module._unfinished(tmp_path / "scene") as work:
        assert work == left
        assert not any(work.iterdir())
    assert not left.exists()
    left.mkdir()
    program = (
        "import sys; from clsplat.files.lock import folder_lock; from pathlib import Path\n"
        "with folder_lock(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, left]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(OutputError, match="another run writes"), module._unfinished(tmp_path / "scene"):
            pass
        other.communicate()
    assert left.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_leaves_nothing(walk: Path, tmp_path: Path) -> None:
    program = "from clsplat_cli.start import main; main()"
    child = subprocess.Popen(
        [sys.executable, "-c", program, "reconstruct", walk, "-o", tmp_path / "scene"],
        stderr=subprocess.PIPE,
        text=True,
        # Shells make background jobs ignore SIGINT, and child processes inherit this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".scene.unfinished/database.db")) and time.monotonic() < deadline:
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    errors = child.communicate(timeout=60)[1]
    assert child.returncode == 130
    assert errors.splitlines()[-1] == "error: interrupted"
    assert not list(tmp_path.iterdir())


def test_estimate_grows_with_photos_and_their_size(tmp_path: Path) -> None:
    small, large = tmp_path / "small.png", tmp_path / "large.png"
    Image.new("L", (400, 300)).save(small)
    Image.new("L", (4000, 3000)).save(large)
    seconds = [
        module.estimate_seconds([PhotoFile(file.name, file)] * count) for file in (small, large) for count in (20, 140)
    ]
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(b"no photo")
    files = [PhotoFile(file.name, file) for file in (damaged, *[small] * 19)]
    assert module.estimate_seconds(files) == seconds[0]
    with pytest.raises(InputError, match=r"damaged\.png: cannot be read"):
        module.estimate_seconds(files[:1])
    assert seconds[0] < min(seconds[1:3])
    assert seconds[3] > 10 * seconds[2], "all pairs: faster than the photos"


def test_pairs_of_a_sequence() -> None:
    assert pairs_of(4, sequential=False) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    pairs = set(pairs_of(100, sequential=True))
    assert {(0, 1), (0, 10), (5, 21), (5, 37), (0, 90), (30, 70)} <= pairs
    assert not {(0, 11), (1, 91), (5, 5)} & pairs
    assert len(pairs) < 0.4 * 99 * 50


def test_warnings_about_photos_without_a_pose(tmp_path: Path) -> None:
    from clsplat.files.images import PhotoHeader
    from clsplat.scenes.reconstruct.photo_files import StagedPhoto

    header = PhotoHeader(8, 8, True, (), b"")
    ready = [StagedPhoto(PhotoFile(f"{n}.jpg", tmp_path), header, f"{n}.jpg") for n in range(10)]
    with pytest.warns(UserWarning, match=r"only 7 of 10 photos could be placed; left out are 7\.jpg, 8\.jpg, 9\.jpg\."):
        module._warn_of_unplaced(tmp_path, ready, ready[:7], {"0": 7, "1": 2})
    with pytest.warns(UserWarning, match=r"fall into 2 parts that do not connect; the largest \(8 photos\)"):
        module._warn_of_unplaced(tmp_path, ready, ready[:8], {"0": 8, "1": 4})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module._warn_of_unplaced(tmp_path, ready, ready, {"0": 10, "1": 4})


def test_options(tmp_path: Path) -> None:
    params = {param.name: param for param in cli.reconstruct_scene.params}
    for name, choices in (("camera_model", CAMERA_MODELS), ("camera_mode", CAMERA_MODES), ("matcher", MATCHERS)):
        assert tuple(params[name].type.choices) == choices
    defaults = {name: param.default for name, param in params.items()}
    for name, value in vars(ReconstructOptions()).items():
        assert defaults[name] == value
    with pytest.raises(InputError, match="camera_model 'LENS': use one of SIMPLE_PINHOLE"):
        ReconstructOptions(camera_model="LENS")
    with pytest.raises(InputError, match="max_size 3: must be 64 to 65535"):
        ReconstructOptions(max_size=3)


@pytest.mark.slow
def test_fisheye_photos_become_pinhole_images(tmp_path: Path) -> None:
    """Photos drawn with an equidistant lens give correct poses, focal length and undistorted images."""
    photo_walk.write_walk(tmp_path / "walk", fisheye=True)
    clsplat("reconstruct", tmp_path / "walk", "-o", tmp_path / "scene", "--camera-model", "OPENCV_FISHEYE")
    scene = load_scene(tmp_path / "scene", eval=False)
    assert scene.names == photo_walk.names()
    off, angle = aligned_error(scene)
    assert off < 0.02
    assert angle < 1
    assert scene.views[0].camera.fx == pytest.approx(photo_walk.FISHEYE_FOCAL, rel=0.05)


@pytest.mark.slow
def test_same_photos_same_model_and_a_video(walk: Path, tmp_path: Path) -> None:
    """Two runs in Python give the same bits, and a video of the photos gives a scene too."""
    steps: list[Step] = []
    files = []
    for name in ("a", "b"):
        reconstruct(walk, tmp_path / name, progress=steps.append)
        files.append(
            [
                (tmp_path / name / "sparse" / "0" / f"{stem}.bin").read_bytes()
                for stem in ("cameras", "images", "points3D")
            ]
        )
    assert files[0] == files[1]
    assert [step for step in steps if step.label == "photos placed"][-1] == Step("photos placed", 8, 8)
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    from clsplat.files.video import VideoWriter

    with VideoWriter(tmp_path / "walk.mp4", 10) as writer:
        for index in range(photo_walk.N_PHOTOS):
            writer.write(photo_walk.picture(index))
    clsplat("train", tmp_path / "walk.mp4", "-m", tmp_path / "model", "--iterations", 5, "--cap-max", 300)
    assert len(load_scene(tmp_path / "model" / "scene").views) == 8
