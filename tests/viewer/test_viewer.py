"""Frames for clients: order, size and content; unusable cameras and failures give blank frames."""

from __future__ import annotations

import contextlib
import math
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from reference.scenes import for_shape, random_camera, random_splats

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import NamedCamera
from clsplat.errors import DeviceError, InputError
from clsplat.rendering.colormaps import MODES, to_bytes
from clsplat.rendering.renderer import Renderer
from clsplat.splats.splats import Splats
from clsplat.viewer.camera import MAX_FOV, AdaptiveResolution, Pose, camera_of, window_of
from clsplat.viewer.initial_view import SceneCameras, initial_view, vertical_fov
from clsplat.viewer.recording import MAX_KEYS, Recording
from clsplat.viewer.render_queue import RenderQueue
from clsplat.viewer.settings import MAX_SIZE, MIN_SIZE, Settings
from clsplat.viewer.source import ModelSource, ModelWatcher, ViewPicture, coverage
from clsplat.viewer.viewer import REST, Viewer, ViewerImage

AHEAD = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 1.0, 96, 64)
BACKGROUND = (0.2, 0.4, 0.6)


def model(n: int = 40, seed: int = 3) -> Splats:
    return Splats("skew-normal", for_shape(random_splats(seed, n, 3, np.float32), "skew-normal"))


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Plain:
    """A source that takes some time and records its calls."""

    modes, partial, splats, n_splats, sh_degree = MODES, True, None, 7, 2

    def __init__(self, clock: Clock, seconds: float = 0.0, error: Exception | None = None) -> None:
        self.calls: list[tuple[Camera, Settings]] = []
        self.clock, self.seconds, self.error = clock, seconds, error

    def view(self, camera: Camera, settings: Settings) -> ViewPicture:
        self.calls.append((camera, settings))
        self.clock.now += self.seconds * camera.width * camera.height / (96 * 64)
        if self.error:
            raise self.error
        return ViewPicture(np.zeros((camera.height, camera.width, 3), np.uint8))


# --- the queue ------------------------------------------------------------------------------


def test_all_clients_get_equal_numbers_of_frames() -> None:
    queue, served = RenderQueue(Clock()), []
    for _ in range(6):
        queue.request(1)
        queue.request(1)
        queue.request(2)
        queue.request(3)
        served.append(queue.next_client(0.0))
    assert served == [1, 2, 3, 1, 2, 3]


def test_a_delayed_request_waits_and_an_earlier_one_replaces_it() -> None:
    clock = Clock()
    queue = RenderQueue(clock)
    queue.request(1, delay=1.0)
    assert not queue.has_due
    assert queue.next_client(0.0) is None
    clock.now = 1.0
    assert queue.has_due
    assert queue.next_client(0.0) == 1
    assert queue.next_client(0.0) is None
    queue.request(1, delay=5.0)
    queue.request(1)
    assert queue.next_client(0.0) == 1
    assert queue.next_client(0.0) is None, "one request, not two"
    queue.request(1)
    queue.request(1, delay=5.0)
    assert queue.next_client(0.0) == 1, "a later request does not delay an earlier one"


def test_a_cancelled_request_is_not_served_and_close_wakes_the_server() -> None:
    queue = RenderQueue()
    queue.request(1)
    queue.cancel(1)
    assert queue.next_client(0.0) is None
    waiting = threading.Thread(target=queue.next_client, args=(60.0,))
    waiting.start()
    queue.close()
    waiting.join(5.0)
    assert not waiting.is_alive()


# --- cameras ---------------------------------------------------------------------------------


def test_the_camera_of_a_browser_is_converted() -> None:
    camera = camera_of(Pose((2.0, 0.0, 2.0, 0.0), (1.0, 2.0, 3.0), math.radians(90), 200, 100), 1000)
    assert camera is not None
    assert (camera.width, camera.height, camera.cx, camera.cy) == (200, 100, 100, 50)
    assert camera.fx == pytest.approx(50)
    assert camera.fy == pytest.approx(50)
    assert np.allclose(camera.position, (1, 2, 3))
    # After a quarter turn about y the camera looks along +x.
    assert np.allclose(camera.rotation[2], (1, 0, 0))


def test_a_smaller_picture_has_the_same_field_of_view() -> None:
    pose = Pose((1, 0, 0, 0), (0, 0, 0), 0.8, 1001, 333)
    full, small = camera_of(pose, 2000), camera_of(pose, 100)
    assert full is not None
    assert small is not None
    assert (small.width, small.height) == (100, 33)
    assert small.width / small.fx == pytest.approx(full.width / full.fx)
    assert small.height / small.fy == pytest.approx(full.height / full.fy)


NONE: list[object] = [
    Pose((math.nan, 0, 0, 0), (0, 0, 0), 1.0, 96, 64),
    Pose((0, 0, 0, 0), (0, 0, 0), 1.0, 96, 64),
    Pose((1, 0, 0), (0, 0, 0), 1.0, 96, 64),
    Pose((1, 0, 0, 0), (0, math.inf, 0), 1.0, 96, 64),
    Pose((1, 0, 0, 0), (0, 1e30, 0), 1.0, 96, 64),
    Pose((1, math.inf, 0, 0), (0, 0, 0), 1.0, 96, 64),
    Pose((1e308, 1e308, 1e308, 1e308), (0, 0, 0), 1.0, 96, 64),
    Pose((1e200, 0, 0, 0), (0, 0, 0), 1.0, 96, 64),
    Pose((1, 0, 0, 0), (0, 0, 0), math.nan, 96, 64),
    Pose((1, 0, 0, 0), (0, 0, 0), 0.0, 96, 64),
    Pose((1, 0, 0, 0), (0, 0, 0), 1.01 * MAX_FOV, 96, 64),
    Pose((1, 0, 0, 0), (0, 0, 0), -1.0, 96, 64),
    Pose((1, 0, 0, 0), (0, 0, 0), 1e300, 96, 64),
    Pose("nonsense", None, "wide", 96, 64),  # type: ignore[arg-type]
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("pose", NONE, ids=range(len(NONE)))
def test_absurd_cameras_are_none(pose: Pose) -> None:
    assert camera_of(pose, 1000) is None


@pytest.mark.filterwarnings("error")
def test_far_splats_have_a_first_view_without_warnings() -> None:
    means = np.full((6, 3), 3e38, np.float32) * np.array([[-1], [1]] * 3, np.float32)
    for some in (means, np.abs(means), means[:0]):
        view = initial_view(some, [])
        assert np.isfinite([view.position, view.look_at]).all()


@pytest.mark.parametrize("size", [(0, 0), (-5, 10), (10**9, 10**9), (math.nan, 3), ("a", 3), (10**400, 1)])
def test_absurd_windows_have_a_size(size: tuple[int, int]) -> None:
    width, height = window_of(Pose((1, 0, 0, 0), (0, 0, 0), 1.0, *size), 256)
    assert 1 <= width <= 256
    assert 1 <= height <= 256


def test_moving_pictures_get_smaller_until_they_come_in_time() -> None:
    """The time of a frame is a constant plus a time for each pixel."""
    for fixed, full in ((0.0, 0.01), (0.005, 0.3), (0.02, 5.0)):
        resolution, times = AdaptiveResolution(0.05), []
        for _ in range(48):
            times.append(fixed + full * resolution.scale**2)
            resolution.update(times[-1])
        steady = times[-8:]
        assert max(steady) <= 0.06, (fixed, full)
        assert resolution.scale == 1.0 or min(steady) > 0.02, (fixed, full)


# --- settings --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("mode", "depth", "depth"),
        ("background", (255, 0, 51), (1.0, 0.0, 0.2)),
        ("size", 640, 640),
        ("size", 1, MIN_SIZE),
        ("size", 10**12, MAX_SIZE),
        ("sh_degree", 1.0, 1),
        ("sh_degree", -4, 0),
        ("cap", 10, 10),
        ("cap", -1, 0),
        ("divider", 0.25, 0.25),
        ("divider", -3, 0.0),
        ("divider", 7, 1.0),
    ],
)
def test_usable_values_are_taken(name: str, value: object, expected: object) -> None:
    assert getattr(Settings().changed(name, value, MODES), name) == expected


def test_none_is_all_splats_and_all_bands() -> None:
    assert Settings(cap=3).changed("cap", None, MODES).cap is None
    assert Settings(sh_degree=1).changed("sh_degree", None, MODES).sh_degree is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mode", "../../etc/passwd"),
        ("mode", None),
        ("mode", ["depth"]),
        ("background", "red"),
        ("background", (1, 2)),
        ("background", (0, 0, 300)),
        ("background", (0, 0, math.nan)),
        ("background", None),
        ("size", math.nan),
        ("size", "640"),
        ("size", math.inf),
        ("sh_degree", {}),
        ("cap", {}),
        ("divider", "0.5"),
        ("divider", math.nan),
        ("divider", None),
    ],
)
def test_unusable_values_change_nothing(name: str, value: object) -> None:
    before = Settings(mode="alpha", cap=3)
    assert before.changed(name, value, MODES) == before


# --- pictures --------------------------------------------------------------------------------


def test_small_while_moving_and_full_when_still() -> None:
    clock = Clock()
    source = Plain(clock, seconds=0.2)
    viewer, shots = Viewer(source, clock=clock), list[ViewerImage]()
    viewer.join(1, shots.append)
    for _ in range(20):
        viewer.move(1, AHEAD)
        assert viewer.serve()
        clock.now += 0.01
    assert not any(shot.still for shot in shots)
    assert max(shot.seconds for shot in shots[5:]) < 0.1
    assert not viewer.serve(), "nothing is due before the camera has come to rest"
    clock.now += REST
    assert viewer.serve()
    assert shots[-1].still
    assert shots[-1].picture.shape == (64, 96, 3)
    assert not viewer.serve(), "a still camera has its picture"


def test_only_the_newest_camera_is_shown() -> None:
    clock = Clock()
    source = Plain(clock)
    viewer = Viewer(source, clock=clock)
    viewer.join(1, lambda shot: None)
    for step in range(5):
        viewer.move(1, Pose((1, 0, 0, 0), (step, 0, 0), 1.0, 96, 64))
    assert viewer.serve()
    assert not viewer.serve()
    assert [camera.position[0] for camera, _ in source.calls] == [4.0]


def test_each_client_has_its_own_settings() -> None:
    clock = Clock()
    source = Plain(clock)
    viewer = Viewer(source, Settings(background=BACKGROUND), clock=clock)
    for who in (1, 2):
        viewer.join(who, lambda shot: None)
        viewer.move(who, AHEAD)
    viewer.choose(1, "mode", "depth")
    viewer.choose(2, "mode", "nonsense")
    viewer.choose(3, "mode", "depth")  # no such client
    assert viewer.serve()
    assert viewer.serve()
    assert [(settings.mode, settings.background) for _, settings in source.calls] == [
        ("depth", BACKGROUND),
        ("colour", BACKGROUND),
    ]


def test_settings_that_arrive_together_are_all_taken() -> None:
    """Messages of one browser come in several threads."""
    both = threading.Barrier(2)

    class Slow(Plain):
        @property
        def modes(self) -> tuple[str, ...]:  # type: ignore[override]
            """Wait for the other thread, if it may come here too."""
            with contextlib.suppress(threading.BrokenBarrierError):
                both.wait(0.5)
            return MODES

    viewer = Viewer(Slow(Clock()))
    viewer.join(1, lambda shot: None)
    changes = [("cap", 5), ("sh_degree", 0)]
    threads = [threading.Thread(target=viewer.choose, args=(1, *change)) for change in changes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert viewer.settings_of(1) == Settings(cap=5, sh_degree=0)


@pytest.mark.parametrize("error", [DeviceError("out of memory"), ValueError("a bug\nof a driver"), MemoryError()])
def test_a_picture_that_cannot_be_made_is_blank_and_says_why(error: Exception) -> None:
    clock, shots = Clock(), list[ViewerImage]()
    viewer = Viewer(Plain(clock, error=error), Settings(background=BACKGROUND), clock=clock)
    viewer.join(1, shots.append)
    viewer.move(1, AHEAD)
    clock.now += 1.0
    assert viewer.serve()
    assert np.array_equal(shots[0].picture, to_bytes(np.broadcast_to(BACKGROUND, (64, 96, 3))))
    assert type(error).__name__ in shots[0].message or str(error) == shots[0].message
    assert "\n" not in shots[0].message


@pytest.mark.parametrize("pose", NONE, ids=range(len(NONE)))
def test_absurd_cameras_see_a_blank_picture(pose: Pose) -> None:
    clock, shots = Clock(), list[ViewerImage]()
    viewer = Viewer(Plain(clock), Settings(background=BACKGROUND), clock=clock)
    viewer.join(1, shots.append)
    viewer.move(1, pose)
    assert viewer.serve()
    assert (shots[0].picture == to_bytes(np.array(BACKGROUND))).all()


def test_a_broken_connection_does_not_disturb_others() -> None:
    clock = Clock()
    viewer, shots = Viewer(Plain(clock), clock=clock), list[ViewerImage]()

    def broken(shot: ViewerImage) -> None:
        raise ConnectionError("reset by peer")

    viewer.join(1, broken)
    viewer.join(2, shots.append)
    for _ in range(2):
        viewer.move(1, AHEAD)
        viewer.move(2, AHEAD)
        viewer.serve()
        viewer.serve()
    assert len(shots) == 2
    assert viewer.count == 1


def test_a_thread_serves_until_it_is_closed() -> None:
    viewer, made = Viewer(Plain(Clock())), threading.Event()
    worker = threading.Thread(target=viewer.run)
    worker.start()
    viewer.join(1, lambda shot: made.set())
    viewer.move(1, AHEAD)
    assert made.wait(5.0)
    viewer.close()
    worker.join(5.0)
    assert not worker.is_alive()


# --- the model -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def source() -> ModelSource:
    return ModelSource(model())


@pytest.mark.parametrize("position", [(0.0, 0.0, -3.0), (0.0, 0.0, 50.0), (9e14, 0.0, 0.0)])
def test_a_full_picture_is_the_render(source: ModelSource, position: tuple[float, float, float]) -> None:
    """The camera is before the splats, sees none, or is as far away as allowed."""
    camera = camera_of(Pose((1, 0, 0, 0), position, 1.0, 96, 64), 1000)
    assert camera is not None
    shown = source.picture(camera, Settings(background=BACKGROUND))
    assert np.array_equal(shown, to_bytes(Renderer().render(model(), camera, BACKGROUND).color))
    assert (shown != shown[0, 0]).any() == (position[2] == -3.0)


def test_pictures_may_be_asked_for_by_several_threads(source: ModelSource) -> None:
    cameras = [random_camera(seed, 41 + 16 * seed, 27) for seed in range(4)]
    alone = [source.picture(camera, Settings()) for camera in cameras]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            together = list(pool.map(lambda camera: source.picture(camera, Settings()), cameras))
            assert all(map(np.array_equal, alone, together))


def test_a_camera_inside_a_splat_sees_something(source: ModelSource) -> None:
    for mean in model().mean[:5].tolist():
        camera = camera_of(Pose((1, 0, 0, 0), mean, 1.0, 96, 64), 1000)
        assert camera is not None
        assert source.picture(camera, Settings()).shape == (64, 96, 3)


def test_fewer_splats_are_those_that_cover_most(source: ModelSource) -> None:
    camera, splats = random_camera(1, 41, 27), model()
    kept = np.sort(np.argsort(-coverage(splats), kind="stable")[:10])
    expected = to_bytes(Renderer().render(splats.select(kept), camera).color)
    assert np.array_equal(source.picture(camera, Settings(cap=10)), expected)
    everything = source.picture(camera, Settings())
    assert np.array_equal(source.picture(camera, Settings(cap=10**6)), everything)
    assert not np.array_equal(expected, everything)
    assert not source.picture(camera, Settings(cap=0)).any()


def test_coverage_is_opacity_times_area() -> None:
    small, dim = model().to_numpy(), model().to_numpy()
    small["log_scale"] -= math.log(2.0)
    assert np.allclose(coverage(Splats("skew-normal", small)), coverage(model()) / 4)
    dim["opacity_logit"][:] = -2.0
    brighter = dim | {"opacity_logit": np.full_like(dim["opacity_logit"], 2.0)}
    assert (coverage(Splats("skew-normal", brighter)) > coverage(Splats("skew-normal", dim))).all()


def test_every_mode_of_an_empty_model_is_a_picture() -> None:
    empty = ModelSource(model().select([]))
    for mode in MODES:
        assert empty.picture(random_camera(1, 41, 27), Settings(mode=mode, cap=3)).shape == (27, 41, 3)


def test_another_model_is_shown_from_the_next_picture_on(source: ModelSource) -> None:
    camera = random_camera(1, 41, 27)
    changing = ModelSource(model())
    before = changing.picture(camera, Settings(mode="skew"))
    changing.show(model(20, 4))
    assert changing.n_splats == 20
    after = changing.picture(camera, Settings(mode="skew"))
    assert not np.array_equal(before, after)
    assert np.array_equal(after, ModelSource(model(20, 4)).picture(camera, Settings(mode="skew")))


# --- the file --------------------------------------------------------------------------------


def test_a_file_is_read_again_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    model(10).save(path)
    watch = ModelWatcher(lambda: path)
    assert watch.poll() is None
    model(20).save(path)
    assert watch.poll() is None, "it may still be growing"
    splats = watch.poll()
    assert splats is not None
    assert len(splats) == 20
    assert watch.poll() is None


def test_a_broken_file_is_said_once_and_mended_by_the_next(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    model(10).save(path)
    whole = path.read_bytes()
    watch = ModelWatcher(lambda: path)
    path.write_bytes(whole[:-50])
    watch.poll()
    with pytest.raises(InputError, match=r"model\.ply"):
        watch.poll()
    assert watch.poll() is None
    path.unlink()
    watch.poll()
    with pytest.raises(InputError, match="does not exist any more"):
        watch.poll()
    with pytest.raises(InputError, match="does not exist any more"):
        watch.reload()
    model(12).save(path)
    watch.poll()
    splats = watch.poll()
    assert splats is not None
    assert len(splats) == 12
    assert len(watch.reload()) == 12


def test_a_file_that_comes_back_as_it_was_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    model(10).save(path)
    there = [True]

    def find() -> Path:
        if not there[0]:
            raise InputError("no point cloud yet")
        return path

    watch = ModelWatcher(find)
    there[0] = False
    with pytest.raises(InputError, match="no point cloud yet"):
        watch.poll()
    there[0] = True
    watch.poll()
    assert watch.poll() is not None, "so that the viewer does not show the error for ever"
    assert watch.poll() is None


def test_a_later_file_takes_over(tmp_path: Path) -> None:
    for n in (10, 20):
        model(n).save(tmp_path / f"{n}.ply")
    names = ["10.ply"]
    watch = ModelWatcher(lambda: tmp_path / names[-1])
    names.append("20.ply")
    watch.poll()
    splats = watch.poll()
    assert splats is not None
    assert len(splats) == 20
    assert watch.path.name == "20.ply"


# --- the first view, and paths --------------------------------------------------------------


def test_it_begins_at_the_first_camera() -> None:
    cameras = [random_camera(seed) for seed in range(3)]
    start = initial_view(np.zeros((5, 3)), cameras)
    assert np.allclose(start.position, cameras[0].position)
    ahead = start.look_at - start.position
    assert np.allclose(ahead / np.linalg.norm(ahead), cameras[0].rotation[2])
    assert start.fov == pytest.approx(2 * math.atan(0.5 * cameras[0].height / cameras[0].fy))


@pytest.mark.parametrize("means", [np.zeros((0, 3)), np.zeros((1, 3)), np.full((4, 3), 7.0), model().mean])
def test_without_cameras_it_looks_at_the_splats(means: np.ndarray) -> None:
    start = initial_view(means, [])
    assert np.linalg.norm(start.look_at - start.position) > 0.5
    assert start.look_at == pytest.approx(np.median(means, axis=0) if len(means) else np.zeros(3))


def test_a_jump_shows_all_of_an_image() -> None:
    camera = Camera(200, 100, 100.0, 100.0, 100.0, 50.0, np.eye(4))
    assert vertical_fov(camera, 4.0) == pytest.approx(2 * math.atan(0.5))
    square = vertical_fov(camera, 1.0)
    assert math.tan(square / 2) == pytest.approx(1.0), "a narrower window has to see higher, to see as wide"


def test_labels_of_cameras_differ() -> None:
    camera = random_camera()
    known = SceneCameras((NamedCamera("a", camera), NamedCamera("a", camera)), (NamedCamera("a", camera),))
    assert len(known.by_label) == 3
    assert known.size > 0


def test_a_recorded_path_goes_through_its_keys(tmp_path: Path) -> None:
    recording = Recording()
    for seed in range(3):
        recording.add(random_camera(seed))
    recording.seconds = 0.5
    path = recording.path(fps=10.0)
    assert len(path.cameras) == 11
    assert np.allclose(path.cameras[0].position, random_camera(0).position)
    assert np.allclose(path.cameras[-1].position, random_camera(2).position)
    assert recording.save(tmp_path).name == "camera_path_001.json"
    assert recording.save(tmp_path).name == "camera_path_002.json"
    recording.remove_last()
    recording.closed = True
    assert len(recording.path(fps=10.0).cameras) == 10
    recording.clear()
    with pytest.raises(InputError, match="has 0 keys"):
        recording.text()


def test_a_path_has_an_end() -> None:
    recording = Recording()
    recording.keys = [random_camera()] * MAX_KEYS
    with pytest.raises(InputError, match="keys already"):
        recording.add(random_camera())
