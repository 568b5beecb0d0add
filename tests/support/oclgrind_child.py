"""Process that test_oclgrind.py runs under Oclgrind: `python oclgrind_child.py WHAT uninitialized|races`.

`main` lists the values of WHAT. Oclgrind 21.10 tracks writes by kernels, and writes of whole buffers by the host. It
does not track host writes at an offset, fills, or buffers in memory that another buffer used before. So this process
replaces the first two by kernels and frees no buffer. Oclgrind also misreads the halves of a vector (`v.hi`), so sums,
ORs and blocks use one lane at a time. It does not support prefetch.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # tests/, which only pytest adds automatically

from reference.scenes import for_shape, random_camera, random_splats

from clsplat.device import memory, program
from clsplat.device.device import Device, open_device
from clsplat.device.schedule import Schedule
from clsplat.rendering import binning, build, frame, pipeline, radix_sort, splat_buffers
from clsplat.rendering.renderer import Renderer
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES
from clsplat.splats.splats import Splats

SCHEDULES = {
    "races": ("1x16x16", "1x32x8", "1x256x1", "32x8x1", "64x4x1", "256x1x1"),
    "uninitialized": ("1x16x16", "1x256x1", "64x4x1"),
}

HAZARDS = (
    "at and behind the near plane",
    "centroid and location across it",
    "values that overflow",
    "screen-filling, 3e5 px",
    "needles 1:10^4",
    "opacity 1",
)

HELPERS = """
kernel void put(global const uint *restrict from, global uint *restrict to, ulong at)
{ to[at + get_global_id(0)] = from[get_global_id(0)]; }
kernel void zero(global uint *restrict to) { to[get_global_id(0)] = 0; }
"""

LANES_ONE_BY_ONE = """
#undef lanes_sum
#define lanes_sum lanes_sum_one_by_one
inline real lanes_sum_one_by_one(vreal v) {
    real part[LANES], sum = 0;
    lanes_store(v, part);
    for (int l = 0; l < LANES; ++l) sum += part[l];
    return sum;
}
#undef lanes_sums
#define lanes_sums(v, n, out) for (int j_ = 0; j_ < (n); ++j_) (out)[j_] = lanes_sum((v)[j_])
#undef lanes_load_block
#undef lanes_store_block
#define lanes_load_block(p, stride) load_block_one_by_one(p, stride)
#define lanes_store_block(v, p, stride) store_block_one_by_one(v, p, stride)
inline vreal load_block_one_by_one(global const real *p, int stride) {
    real part[LANES];
    for (int l = 0; l < LANES; ++l) part[l] = p[l / BLOCK_W * stride + l % BLOCK_W];
    return lanes_load(part);
}
inline void store_block_one_by_one(vreal v, global real *p, int stride) {
    real part[LANES];
    lanes_store(v, part);
    for (int l = 0; l < LANES; ++l) p[l / BLOCK_W * stride + l % BLOCK_W] = part[l];
}
#define lanes_or lanes_or_one_by_one
inline mask_int lanes_or_one_by_one(vmask m) {
    const mask_int *part = (const mask_int *)&m;
    mask_int bits = 0;
    for (int l = 0; l < LANES; ++l) bits |= part[l];
    return bits;
}
"""

NO_PREFETCH = """
#undef prefetch_reals
#define prefetch_reals(p, n)
"""

FAULTS = """
kernel void beyond(global uint *restrict x) { x[16] = 1; }
kernel void unwritten(global uint *restrict x) { if (x[3] == 7) x[4] = 1; }
kernel void race(global uint *restrict x) {
    local uint shared_value;
    if (get_local_id(0) == 0) shared_value = x[15];
    x[get_local_id(0) / 2] = shared_value;
}
"""


def append_to_sources(more: dict[str, str]) -> None:
    """Append text to the sources of these names in every build."""
    join = program.source

    def source(*names: str) -> str:
        return "".join(join(name) + more.get(name, "") for name in names)

    program.source = source


def make_traceable(device: Device) -> None:
    """Replace host writes that Oclgrind cannot track, and sums that it misreads."""
    kept: list[Any] = []
    alloc = device.alloc

    def keep(nbytes: int) -> Any:
        kept.append(alloc(nbytes))
        return kept[-1]

    device.alloc = keep  # type: ignore[method-assign]
    append_to_sources({"math/lanes.clh": LANES_ONE_BY_ONE})
    helpers = program.build_text(device, HELPERS)

    def fill_zero(device: Device, buffer: Any, nbytes: int) -> None:
        helpers.zero((nbytes // 4,), None, to=buffer)

    def to_device(device: Device, buffer: Any, array: Any, offset: int = 0) -> None:
        words = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if words.size:
            staged = device.alloc(words.nbytes)
            cl.enqueue_copy(device.queue, staged, words)
            helpers.put((words.size,), None, **{"from": staged, "to": buffer, "at": offset // 4})

    def send_to_device(device: Device, buffer: Any, array: Any) -> None:
        to_device(device, buffer, array)

    for module in (memory, frame, pipeline, splat_buffers):
        for replaced in (fill_zero, to_device, send_to_device):
            if hasattr(module, replaced.__name__):
                setattr(module, replaced.__name__, replaced)


def render_some(device: Device, mode: str) -> None:
    """Test a skewed and a two-sided shape on one schedule of lanes and one of groups."""
    render_and_back(device, (DEFAULT_SHAPE, "bisected-skew"), ("1x16x16", "64x4x1"))


def render_all(device: Device, mode: str) -> None:
    """Test all shapes on every kind of schedule."""
    render_and_back(device, tuple(SHAPES), SCHEDULES[mode])


def render_and_back(device: Device, shapes: tuple[str, ...], schedules: tuple[str, ...]) -> None:
    """Render 5 splats in a 20 x 18 image of 4 tiles."""
    camera = random_camera(1, 20, 18)
    arrays = random_splats(3, 5, 1, np.float32)
    rng = np.random.default_rng(0)
    v_color, v_alpha = rng.normal(size=(18, 20, 3)), rng.normal(size=(18, 20))
    for shape in shapes:
        fields = {name: value.astype(np.float32) for name, value in for_shape(arrays, shape).items()}
        splats = Splats(shape, fields)
        for schedule in schedules:
            renderer = Renderer(device, schedule=Schedule.parse(schedule))
            image = renderer.render(splats, camera)
            gradients = renderer.backward(v_color, v_alpha)
            assert np.abs(image.alpha).mean() > 0.05
            assert all(np.abs(value).max() > 0 for value in gradients.values())


def render_hazards(device: Device, mode: str) -> None:
    """Render crafted splats (benchmarks/hazards). The values of images and gradients do not matter."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
    from hazards import crafted

    renderer = Renderer(device, schedule=Schedule.parse("1x16x16"))
    for name in HAZARDS:
        for shape in ("gaussian", "skew-normal-direct"):
            arrays = crafted.STATIC[name](SHAPES[shape])
            if arrays:
                splats = Splats(shape, {key: values[:16].astype(np.float32) for key, values in arrays.items()})
                image = renderer.render(splats, crafted.camera())
                renderer.backward(np.ones_like(image.color))


def sort_and_scan(device: Device, mode: str) -> None:
    """Sort across a block boundary, and order by depth with few work-items and with chunks and small buckets."""
    rng = np.random.default_rng(0)
    for n in (300, 4100):
        pool = memory.Pool(device)
        sorter, pairs = radix_sort.Sorter(pool), radix_sort.SortMemory(pool)
        keys = rng.integers(0, 50, n, np.uint32)
        memory.to_device(device, pairs.keys.reserve(n), keys)
        _, order = sorter.sort(pairs.keys.buffer, n, 6, pairs)
        got = memory.to_host(device, order, np.empty(n, np.uint32))
        assert np.array_equal(got, np.argsort(keys, kind="stable"))
    n = 4100
    keys = rng.choice(rng.integers(0, 2**31, 60, np.uint32), n)
    depth_key, unused = device.alloc(keys.nbytes), device.alloc(4)
    memory.to_device(device, depth_key, keys)
    binner = binning.ChunkBinner(memory.Pool(device), build.KernelBuild("gaussian", 0, Schedule(1, 16, 16)))
    binner.order(frame.ProjectedSplats(n, n, unused, unused, depth_key, unused))
    got = binner.depth_order.read(n)
    assert np.array_equal(got, np.argsort(keys, kind="stable"))


def faults(device: Device, mode: str) -> None:
    """Run kernels with planted faults, which Oclgrind must report."""
    built = program.build_text(device, FAULTS)
    for kernel in (built.beyond, built.unwritten):
        kernel((1,), None, x=device.alloc(64)).wait()
    built.race((16,), (16,), x=device.alloc(64)).wait()


def main() -> None:
    what, mode = sys.argv[1:]
    device = open_device("oclgrind")
    append_to_sources({"render/group.clh": NO_PREFETCH})
    if mode == "uninitialized":
        make_traceable(device)
    {
        "render": render_some,
        "render-all": render_all,
        "render-hazards": render_hazards,
        "sort": sort_and_scan,
        "faults": faults,
    }[what](device, mode)
    device.finish()
    print("finished")


if __name__ == "__main__":
    main()
