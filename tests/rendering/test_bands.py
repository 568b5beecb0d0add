"""Images and gradients in bands of tiles equal those of a single band, and binning equals NumPy's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_schedules import as_kind, schedule_on
from numpy.typing import NDArray
from reference.scenes import for_shape, random_camera, random_splats
from reference.tolerances import relative_error
from small_scene import write_garden

from clsplat.device import device as device_module
from clsplat.device import program
from clsplat.device.device import Device
from clsplat.device.memory import Pool, to_device, to_host
from clsplat.device.schedule import SCHEDULES, Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering.binning import MAX_ISECTS, Band, ChunkBinner, cut_bands
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import DeviceImage, Frame, ProjectedSplats
from clsplat.rendering.group_binner import GroupBinner
from clsplat.rendering.overdraw import count_pairs
from clsplat.rendering.pipeline import Pipeline, isect_limit
from clsplat.rendering.splat_buffers import ParameterBuffers, SplatBuffers
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.scenes.scene import load_scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.memory_estimate import Estimate, check, room_for_isects
from clsplat.training.trainer import Trainer

WIDTH, HEIGHT, N = 103, 71, 300  # 7 x 5 tiles
IMAGES = ("color", "transmittance", "depth")
CULLED = 0xFFFFFFFF

# Bands do not change the order of sums. But Intel's compiler adds the records of a splat in groups, and bands divide
# these groups differently. The tolerance is relative to the largest entry of a field. The largest error is 4e-6 (skew).
REGROUPED = 2e-5
NEAR = 0.01  # the nearest depth of the tests of binners
POCL = "Portable Computing Language"

Arrays = dict[str, NDArray[Any]]


def rendered(device: Device, shape: str, schedule: str, max_isects: int | None) -> tuple[Pipeline, Frame, Arrays]:
    """Render a random scene and differentiate it with random weights. Images are read after the gradient."""
    arrays = for_shape(random_splats(4, N, 1), shape)
    splats = Splats(shape, {name: value.astype(np.float32) for name, value in arrays.items()})
    kernels = KernelBuild(shape, 1, Schedule.parse(schedule)).for_rendering()
    pipeline = Pipeline(device, kernels, max_isects)
    buffers = SplatBuffers.of(device, splats, kernels.dtype)
    frame = pipeline.forward(buffers, random_camera(4, WIDTH, HEIGHT), (0.2, 0.5, 0.9))
    rng, layout = np.random.default_rng(0), frame.layout
    v_color = DeviceImage(pipeline.pool, kernels.dtype, 3).write(layout, rng.normal(size=(HEIGHT, WIDTH, 3)))
    v_alpha = DeviceImage(pipeline.pool, kernels.dtype, 1).write(layout, rng.normal(size=(HEIGHT, WIDTH)))
    grads = ParameterBuffers(device, splats.schema, N, kernels.dtype)
    pipeline.backward(frame, v_color, grads, v_alpha)
    return pipeline, frame, grads.download(N) | {name: getattr(frame.images, name).read() for name in IMAGES}


def assert_same(got: Arrays, want: Arrays, tolerance: float = 0.0) -> None:
    """Images are equal bit for bit, and gradients within the tolerance."""
    assert set(got) == set(want)
    for name, values in want.items():
        assert np.abs(values).max() > 0, name
        assert relative_error(got[name], values) <= (0.0 if name in IMAGES else tolerance), name


# The smallest limit divides rows of tiles.
@pytest.mark.parametrize(
    ("kind", "shape", "schedule"),
    [
        ("CPU", "gaussian", "cpu16"),
        ("CPU", "skew-normal", "cpu8"),
        ("GPU", "gaussian", "gpu64"),
        ("GPU", "skew-normal", "cpu16"),
    ],
)
def test_bands_give_what_one_band_gives(device: Device, kind: str, shape: str, schedule: str) -> None:
    schedule_on(device, schedule)
    device = as_kind(device, kind)
    whole, frame_of_one, want = rendered(device, shape, schedule, None)
    n_isects = frame_of_one.n_isects
    assert len(frame_of_one.bands) == 1
    fullest = max(whole.binner.count(tile, tile + 1) for tile in range(35))
    pairs = count_pairs(whole, frame_of_one)
    for limit in (n_isects - 1, n_isects // 4, fullest):
        pipeline, frame, got = rendered(device, shape, schedule, limit)
        assert len(frame.bands) > 1
        whole_rows = all((band.end - band.first) % 7 == 0 for band in frame.bands)
        assert whole_rows or limit < n_isects - 1
        assert limit > fullest or not whole_rows
        assert frame.n_isects == n_isects
        assert max(band.n_isects for band in frame.bands) <= limit
        assert_same(got, want, 0.0 if device.info.platform == POCL else REGROUPED)
        assert count_pairs(pipeline, frame) == pairs
    with pytest.raises(DeviceError, match=rf"{fullest} splats over one tile, and buffers for {fullest - 1} at most"):
        rendered(device, shape, schedule, fullest - 1)


def test_both_binners_give_the_same(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiler may also add in a different order for a different group size."""
    monkeypatch.setattr(program, "GPU_OPTIONS", ())  # pixels of GPUs have no other functions and roundings here
    monkeypatch.setattr(device_module, "_NATIVE_PLATFORMS", ())
    schedule = str(default_schedule(device.info))
    assert_same(
        rendered(as_kind(device, "GPU"), "gaussian", schedule, None)[2],
        rendered(as_kind(device, "CPU"), "gaussian", schedule, None)[2],
        0.0 if device.info.platform == POCL else REGROUPED,
    )


def test_training_in_bands_has_the_same_bits(devices: list[Device], tmp_path: Path) -> None:
    device = next((device for device in devices if device.info.platform == POCL), None)
    if device is None:
        pytest.skip("only PoCL keeps the exact order of sums")
    scene = load_scene(write_garden(tmp_path))
    config = TrainConfig(iterations=30, cap_max=200, densify_interval=5, coarse_to_fine=False)
    trained = []
    for limit in (MAX_ISECTS, 100):
        trainer = Trainer(scene, config, device=device)
        trainer.pipeline.max_isects = limit
        for _ in range(config.iterations):
            frame = trainer.step()
        assert (len(frame.bands) > 1) == (limit == 100)
        trained.append(trainer.snapshot().to_numpy())
    assert_same(*trained)


def test_cutting_halves_rows_first() -> None:
    tiles = np.full(12, 10)  # 4 x 3
    tiles[5] = 30
    bands = cut_bands(lambda first, past: int(tiles[first:past].sum()), 4, 3, 40)
    assert bands == (Band(0, 4, 40), Band(4, 6, 40), Band(6, 8, 20), Band(8, 12, 40))
    assert cut_bands(lambda first, past: 0, 4, 3, 40) == (Band(0, 12, 0),)
    with pytest.raises(DeviceError, match="30 splats over one tile"):
        cut_bands(lambda first, past: int(tiles[first:past].sum()), 4, 3, 29)


@pytest.mark.parametrize("n", [1, 300, 2049, 40_000])
@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_binning_is_that_of_numpy(device: Device, kind: str, n: int) -> None:
    """Test near, far and equal depths, culled splats, and rectangles up to the whole image, for all tiles and bands."""
    device = as_kind(device, kind)
    (tiles_x, tiles_y), rng = (9, 6), np.random.default_rng(n)
    binner = make_binner(device, kind)
    size = np.array([tiles_x, tiles_y])
    low = rng.integers(0, size, (n, 2))
    rect = np.concatenate([low, np.minimum(low + rng.integers(1, 8, (n, 2)) ** 2 // 9 + 1, size)], 1).astype(np.int32)
    for depth in (
        10.0 ** rng.uniform(-2, 8, n),
        10.0 ** rng.uniform(-2, 36, n),
        np.full(n, NEAR),
        np.full(n, 3.0),
        rng.integers(1, 5, n),
        np.full(n, np.inf),
    ):
        keys = depth.astype(np.float32).view(np.uint32).copy()
        keys[rng.random(n) < 0.2] = CULLED
        keys[np.isinf(depth)] = CULLED
        rect[keys == CULLED] = 0
        binner.order(projected(device, keys, rect))
        for first, end in ((0, 54), (13, 31), (20, 21)):
            binner.begin(tiles_x, tiles_y)
            check_band(device, binner, keys, rect, first, end, size)


def make_binner(device: Device, kind: str) -> ChunkBinner | GroupBinner:
    """Return the binner of a kind of device; depths start at NEAR."""
    kernels = KernelBuild("gaussian", 0, SCHEDULES["cpu16"], near_plane=NEAR)
    return ChunkBinner(Pool(device), kernels) if kind == "CPU" else GroupBinner(Pool(device), kernels)


def projected(device: Device, keys: NDArray[np.uint32], rect: NDArray[np.int32]) -> ProjectedSplats:
    """Return splats with these depth keys and tile rectangles. Binners do not use the camera and the records."""
    unused, depth_key, tile_rect = (device.alloc(nbytes) for nbytes in (4, keys.nbytes, rect.nbytes))
    to_device(device, depth_key, keys)
    to_device(device, tile_rect, rect)
    return ProjectedSplats(len(keys), len(keys), unused, unused, depth_key, tile_rect)


@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_any_number_of_tiles_is_sorted(device: Device, kind: str) -> None:
    """Tile indices of one bit more need another pass of the sort: 16 and 17 tiles, 256 and 257 tiles."""
    device, rng, n = as_kind(device, kind), np.random.default_rng(1), 40
    binner = make_binner(device, kind)
    for tiles_x, tiles_y in ((1, 1), (4, 4), (17, 1), (5, 5), (16, 16), (257, 1), (20, 25)):
        size = np.array([tiles_x, tiles_y])
        low = rng.integers(0, size, (n, 2))
        rect = np.concatenate([low, low + rng.integers(1, size - low + 1)], 1).astype(np.int32)
        keys = rng.integers(1, 5, n).astype(np.float32).view(np.uint32)
        binner.order(projected(device, keys, rect))
        binner.begin(tiles_x, tiles_y)
        check_band(device, binner, keys, rect, 0, tiles_x * tiles_y, size)


def check_band(
    device: Device,
    binner: ChunkBinner | GroupBinner,
    keys: NDArray[np.uint32],
    rect: NDArray[np.int32],
    first: int,
    end: int,
    size: NDArray[np.int64],
) -> None:
    """Compare the list of each tile, front to back, and the isects of each splat, in the order of its tiles."""
    order = np.argsort(keys, kind="stable")
    tiles = np.arange(first, end)
    x, y = tiles % size[0], tiles // size[0]
    x0, y0, x1, y1 = rect[order].T[:, :, None]
    inside = (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)  # [rank, tile]
    ids = np.cumsum(inside).reshape(inside.shape) - 1
    total = int(inside.sum())
    binner_count = binner.count(first, end)
    assert binner_count == total
    binner.count(0, 1)  # the lists do not depend on what was counted last
    lists = binner.list_isects(Band(first, end, total))
    isects = to_host(device, lists.isects, np.empty(total, np.uint32))
    ranges = to_host(device, lists.ranges, np.empty((size.prod(), 2), np.uint32))
    splat_of = to_host(device, lists.isect_splat, np.empty(total, np.uint32))
    splat_isects = to_host(device, lists.splat_isects, np.empty((len(keys), 2), np.uint32))
    outside = np.ones(size.prod(), bool)
    outside[first:end] = False
    assert not (ranges[outside, 1] - ranges[outside, 0]).any()
    ranges = ranges[first:end]
    assert np.array_equal(ranges[:, 1] - ranges[:, 0], inside.sum(0))
    for tile in range(end - first):
        assert np.array_equal(isects[slice(*ranges[tile])], ids[inside[:, tile], tile])
    assert np.array_equal(splat_of, order[np.nonzero(inside)[0]])
    assert np.array_equal(splat_isects[order, 1] - splat_isects[order, 0], inside.sum(1))
    starts = np.cumsum(inside.sum(1)) - inside.sum(1)
    some = inside.any(1)
    assert np.array_equal(splat_isects[order, 0][some], starts[some])


def test_counts_beyond_32_bits(device: Device) -> None:
    """70 000 splats over 65 536 tiles: the count of more than 2^32 isects does not overflow."""
    n, side = 70_000, 256
    for kind in ("GPU",) if device.info.ends_long_loops else ("CPU", "GPU"):
        other = as_kind(device, kind)
        binner = make_binner(other, kind)
        rect = np.tile(np.array([0, 0, side, side], np.int32), (n, 1))
        binner.order(projected(other, np.ones(n, np.uint32), rect))
        binner.begin(side, side)
        assert binner.count(0, side * side) == n * side * side
        assert binner.count(5, 7) == 2 * n


def test_many_splats_are_all_listed(device: Device) -> None:
    """Mesa's software device ends long loops: with the binner of CPUs it lost a tenth of these isects."""
    n = 300_000
    scene, splats = synthetic_scene(n, 96, 64, "gaussian")
    kernels = KernelBuild("gaussian", 3, default_schedule(device.info))
    pipeline = Pipeline(device, kernels)
    frame = pipeline.forward(SplatBuffers.of(device, splats, kernels.dtype), scene.train[0].camera)
    rects = to_host(device, frame.projected.tile_rect, np.empty((n, 4), np.int32)).astype(np.int64)
    area = ((rects[:, 2] - rects[:, 0]) * (rects[:, 3] - rects[:, 1])).sum()
    assert sum(band.n_isects for band in frame.bands) == area > 2 * n // 3
    order = np.argsort(to_host(device, frame.projected.depth_key, np.empty(n, np.uint32)), kind="stable")
    for band, lists in pipeline.bands(frame):
        splat_of = to_host(device, lists.isect_splat, np.empty(band.n_isects, np.uint32))
        assert len(np.unique(splat_of)) == (rects[order, 2] > rects[order, 0]).sum()


def test_the_limit_follows_the_device(devices: list[Device]) -> None:
    kernels = KernelBuild("gaussian", 0, SCHEDULES["cpu16"])
    device = as_kind(devices[0], "CPU")
    device.info = replace(device.info, max_alloc_bytes=36_000, global_mem_bytes=1 << 40)
    assert isect_limit(device, kernels) == 1000
    device.info = replace(device.info, max_alloc_bytes=1 << 40, global_mem_bytes=180_000)
    assert isect_limit(device, kernels) == 1000
    device.info = replace(device.info, global_mem_bytes=1 << 50)
    assert isect_limit(device, kernels) == MAX_ISECTS


def test_isects_alone_refuse_no_run(devices: list[Device]) -> None:
    """1000 MB of isects need bands if splats and images leave 300 MB, and are refused if they leave 60 MB."""
    device, needed = as_kind(devices[0], "CPU"), Estimate(500 * 10**6, 10**9, 200 * 10**6, 60, 10**6)
    device.info = replace(device.info, max_alloc_bytes=1 << 30, global_mem_bytes=10**9)
    check(needed, device)
    assert room_for_isects(needed, device.info) == 300 * 10**6 * 2 // 180
    device.info = replace(device.info, global_mem_bytes=760 * 10**6)
    with pytest.raises(DeviceError, match="the run needs about"):
        check(needed, device)
