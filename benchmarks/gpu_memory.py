"""Memory of a training run on GPUs of 8, 12 and 24 GB, by the estimate that `clsplat train` prints before a run.

    python benchmarks/gpu_memory.py               # print the table
    python benchmarks/gpu_memory.py --write       # write it into GPU.md, too

A buffer may have a quarter of the memory, as NVIDIA's driver reports it. The photos stay on the device if they fit into
another quarter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import common

from clsplat.device.device import DeviceInfo
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.frame import ImageLayout
from clsplat.rendering.pipeline import isect_limit
from clsplat.training.config import TrainConfig
from clsplat.training.memory_estimate import Estimate, estimate, fault, most_splats, room_for_isects
from clsplat.training.programs import kernel_build

PAGE = common.ROOT / "benchmarks" / "GPU.md"
SHAPES = ("gaussian", "skew-normal")
SPLATS = (1_000_000, 5_000_000)
IMAGES = {"1080p": (1920, 1080), "4K": (3840, 2160)}
GIGABYTES = (8, 12, 24)
PHOTOS = 200  # of a scene, each with three bytes a pixel
_BEGIN, _END = "<!-- table of gpu_memory.py -->", "<!-- end of the table of gpu_memory.py -->"


def main() -> None:
    parser = common.parser(__doc__, device=False, table=False, smoke=False)
    parser.add_argument("--write", action="store_true", help="write the table into GPU.md")
    args = parser.parse_args()
    text = table()
    print(text)
    if args.write:
        common.write_between(PAGE, _BEGIN, _END, text)


@dataclass(frozen=True)
class Case:
    """A run: its shape, its splats, and its images."""

    shape: str
    splats: int
    image: str

    @property
    def config(self) -> TrainConfig:
        return TrainConfig(shape=self.shape, cap_max=self.splats)

    @property
    def layout(self) -> ImageLayout:
        return ImageLayout(*IMAGES[self.image])

    def photos(self, info: DeviceInfo) -> int:
        """Return the bytes of photos on a device, as `target_bytes` bounds them."""
        one = 3 * self.layout.plane
        return min(PHOTOS * one, info.global_mem_bytes // 4) + 3 * one

    def needed(self, info: DeviceInfo) -> Estimate:
        """Return the estimate of the run on a device."""
        return estimate(self.config, _kernels(self.config), self.layout, self.photos(info))

    def verdict(self, info: DeviceInfo) -> str:
        """Return the memory in GB, and whether it fits: in one piece, in bands, or with how many splats."""
        needed, kernels = self.needed(info), _kernels(self.config)
        total = f"{1e-9 * needed.total:.1f} GB"
        if fault(needed, info) is not None:
            cap = most_splats(self.config, kernels, self.layout, self.photos(info), info)
            return f"{total}: at most {1e-6 * cap:.1f} M splats"
        device: Any = SimpleNamespace(info=info)
        most_isects = min(isect_limit(device, kernels), room_for_isects(needed, info))
        if needed.isects > most_isects * needed.isect:
            return f"{total}: bands of {1e-6 * most_isects:.0f} M isects"
        return f"{total}: fits"


def table() -> str:
    """Return the table of all runs and sizes of memory."""
    numbers = ("splats", "bytes a splat", "bytes an isect", "largest buffer", "of 8 GB")
    head = ("shape", *numbers[:1], "image", *numbers[1:], *(f"{gigabytes} GB" for gigabytes in GIGABYTES))
    return common.table(head, map(row, cases()), numbers)


def cases() -> Iterator[Case]:
    """Yield all runs."""
    for shape in SHAPES:
        for splats in SPLATS:
            for image in IMAGES:
                yield Case(shape, splats, image)


def row(case: Case) -> tuple[object, ...]:
    """Return the cells of a run."""
    devices = [device_of(gigabytes) for gigabytes in GIGABYTES]
    needed = case.needed(devices[0])
    kernels, n_isects = _kernels(case.config), needed.isects // needed.isect
    largest = max(needed.largest_buffer, n_isects * kernels.v_record * kernels.dtype.itemsize)
    return (
        case.shape,
        f"{1e-6 * case.splats:g} M",
        case.image,
        f"{needed.splats / case.splats:.0f}",
        needed.isect,
        f"{1e-6 * largest:.0f} MB",
        f"{largest / devices[0].global_mem_bytes:.0%}",
        *(case.verdict(info) for info in devices),
    )


def device_of(gigabytes: int) -> DeviceInfo:
    """Return a GPU with this memory, whose buffers may have a quarter of it."""
    memory = gigabytes << 30
    return DeviceInfo(
        "0:0", "", "", f"GPU of {gigabytes} GB", "", "", "GPU", memory, memory // 4, 48 << 10, 1024, False, 1
    )


def _kernels(config: TrainConfig) -> Any:
    return kernel_build(config, SCHEDULES["gpu64"])


if __name__ == "__main__":
    main()
