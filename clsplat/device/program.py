"""OpenCL programs from the package's sources, and kernels whose arguments are bound by name.

Sources are joined here, with `#line`, and never `#include` one another. So every cache sees the whole text, and errors
name the file. Signatures are read from that text (kernel_args.py). Between processes a program is kept by its driver or
by program_cache.py, never by pyopencl's cache.
"""

from __future__ import annotations

import importlib.resources
import math
import os
import re
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import activity
from ..errors import OTHER_DEVICE, DeviceError, Remedy
from .device import BROKEN_POCL, LESS_MEMORY, RUSTICL, Device, DeviceInfo
from .kernel_args import Parameter, Signatures, parse_signatures
from .kernel_args import Real as Real  # of this module's interface
from .memory import to_device, to_host
from .opencl import Event, KernelArgument, elapsed_ms, first_line, is_out_of_memory
from .program_cache import binary_path, load_binary, store_binary

if TYPE_CHECKING:
    import pyopencl

Define = int | float | str

OPTIONS = ("-cl-std=CL1.2", "-cl-mad-enable")  # never fast-relaxed-math: infinities and NaN have meaning
GPU_OPTIONS = ("-cl-denorms-are-zero",)  # denormal numbers take three more instructions for each exp
OPTIONS_VARIABLE = "CLSPLAT_BUILD_OPTIONS"  # further options from the environment: -Werror in tests

SMOKE_TOLERANCE = 1e-5  # relative; OpenCL allows an error of 16 ulp in erfc, 6e-8 each

# Mesa 22.3 says 32 for every kernel of its software device, which runs larger groups.
_WITHOUT_LIMITS = frozenset({RUSTICL})
GROUP_ITEMS = 64  # of kernels with one work-item per splat or isect


def source(*names: str) -> str:
    """Return the text of source files, joined in order, each after its `#line`.

    Names are those of the package ("render/rasterize.cl", "shape/gaussian.clh") or absolute paths.
    """
    return "".join(f'#line 1 "{name}"\n{_read(name)}\n' for name in names)


def build(
    device: Device,
    files: tuple[str, ...],
    defines: Mapping[str, Define] | None = None,
    real: Real = "float",
) -> Program:
    """Return the program of source files; a process builds it once for each device, text, defines and `real`.

    Parameters
    ----------
    files : names as for `source`; a file stands after those that it uses.
    defines : become `#define` lines before the text; floats become literals of type `real`.
    real : type of the kernels' real numbers. REAL_DOUBLE is defined as 0 or 1, and so are HAS_PREFETCH and
        HAS_EXACT_NATIVE of the device.

    Raises
    ------
    DeviceError : the device has no doubles, or the build failed (device, first error line, defines).
    """
    defines = dict(defines or {})
    key = (files, tuple(sorted(defines.items())), real, os.environ.get(OPTIONS_VARIABLE, ""))
    if key not in device.programs:
        built, text = device.shared.built, source(*files)
        read = (with_defines(text, defines, real, device.info), *_options(device.info))  # all that the compiler reads
        if read not in built:
            activity.report(f"compiling kernels: {Path(files[-1]).stem}")
            built[read] = _built(device, text, defines, real)
        device.programs[key] = Program(device, *built[read])
    return device.programs[key]


def build_text(device: Device, text: str, defines: Mapping[str, Define] | None = None, real: Real = "float") -> Program:
    """Return the program of OpenCL C text. It is built at every call; otherwise like `build`."""
    return Program(device, *_built(device, text, dict(defines or {}), real))


def _built(device: Device, text: str, defines: Mapping[str, Define], real: Real) -> tuple[pyopencl.Program, Signatures]:
    """The built program and its signatures; DeviceError as in `build`."""
    import pyopencl as cl

    if real == "double" and not device.has_fp64:
        raise DeviceError(f"device {device.info} has no double precision", Remedy("use float32"), OTHER_DEVICE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", cl.CompilerWarning)  # some compilers warn at every success
            built = _compiled(device, whole := with_defines(text, defines, real, device.info), _options(device.info))
    except cl.Error as error:
        raise _build_error(device, error, whole, defines, real) from None
    return built, parse_signatures(text, real, defines)


def with_defines(text: str, defines: Mapping[str, Define], real: Real, info: DeviceInfo) -> str:
    """Return the text that a compiler reads: `#define` lines, then OpenCL C."""
    flags = {
        "REAL_DOUBLE": real == "double",
        "HAS_PREFETCH": info.has_prefetch,
        "HAS_EXACT_NATIVE": info.has_exact_native,
    }
    lines = [f"#define {name} {int(flag)}" for name, flag in flags.items()]
    lines += [f"#define {name} {_literal(name, value, real)}" for name, value in defines.items()]
    return "\n".join([*lines, text])


def _options(info: DeviceInfo) -> list[str]:
    """Options of a build for a device."""
    for_type = GPU_OPTIONS if info.type == "GPU" else ()
    return [*OPTIONS, *for_type, *os.environ.get(OPTIONS_VARIABLE, "").split()]


def lane_group(device: Device) -> int:
    """Return the group size for kernels whose work-items are vectors of splats.

    A CPU gets groups of one: its lanes do the work, and PoCL adds up the private arrays of all items of a group.
    `Kernel.over` makes groups smaller where a kernel has a smaller limit.
    """
    return 1 if device.info.type == "CPU" else GROUP_ITEMS


class Program:
    """A built program. `program["name"]` and `program.name` return a Kernel, the same one each time."""

    def __init__(self, device: Device, built: pyopencl.Program, signatures: Signatures) -> None:
        self.device = device
        self.signatures = signatures
        self._built = built
        self._kernels: dict[str, Kernel] = {}

    def __getitem__(self, name: str) -> Kernel:
        if name not in self._kernels:
            if name not in self.signatures:
                raise KeyError(f"no kernel {name!r}; this program has {', '.join(sorted(self.signatures))}")
            self._kernels[name] = Kernel(self.device, self._built, name, self.signatures[name])
        return self._kernels[name]

    def __getattr__(self, name: str) -> Kernel:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None


class Kernel:
    """A kernel, called as `kernel(global_size, local_size, name=value, ...)`.

    Values are buffers for `global` pointers, numbers for scalars and sizes in bytes for `local` pointers.
    Kernels are not thread-safe, because OpenCL's kernel objects are not.

    Attributes
    ----------
    max_group : largest work-group. Apple's CPU devices have groups of one in kernels with barriers.
    item_group : group size of kernels that work with any size, at most GROUP_ITEMS.
    """

    def __init__(self, device: Device, built: pyopencl.Program, name: str, parameters: tuple[Parameter, ...]) -> None:
        import pyopencl as cl

        self.name = name
        self.parameters = parameters
        self._device = device
        self._kernel = cl.Kernel(built, name)
        if self._kernel.num_args != len(parameters):
            raise DeviceError(f"kernel {name}: {self._kernel.num_args} parameters built, {len(parameters)} in its text")
        self._names = tuple(p.name for p in parameters)
        self._local = tuple(i for i, p in enumerate(parameters) if p.kind == "local")
        self._kernel.set_scalar_arg_dtypes([p.dtype for p in parameters])
        self.max_group = _max_group(self._kernel, device)
        self.item_group = min(GROUP_ITEMS, 1 << (self.max_group.bit_length() - 1))
        self._local_memory: Callable[[Any], Any] = cl.LocalMemory
        self._enqueue: Callable[..., Any] = cl.enqueue_nd_range_kernel
        self._marker: Callable[..., Any] = cl.enqueue_marker
        self._cl_error: type[Exception] = cl.Error

    def __call__(
        self, global_size: tuple[int, ...], local_size: tuple[int, ...] | None, /, **args: KernelArgument
    ) -> Event:
        """Enqueue the kernel on the device's queue and return its event.

        With an empty global size nothing runs; OpenCL 1.2 itself would refuse it.

        Raises
        ------
        TypeError : an argument is missing, unknown, or of the wrong kind.
        DeviceError : the device refused the launch.
        """
        try:
            values: list[Any] = [args[name] for name in self._names]
        except KeyError:
            values = []
        if len(values) != len(self._names) or len(args) != len(values):
            raise TypeError(self._mismatch(set(args)))
        for i in self._local:
            values[i] = self._local_memory(values[i])
        if 0 in global_size:
            return self._marker(self._device.queue)
        try:
            self._kernel.set_args(*values)
        except Exception as error:  # of pyopencl and struct; some are bare RuntimeErrors
            raise TypeError(f"kernel {self.name}: {first_line(error)}, parameters {self._names}") from error
        try:
            event = self._enqueue(self._device.queue, self._kernel, global_size, local_size)
        except self._cl_error as error:
            failed = f"kernel {self.name} on {self._device.info}: {first_line(error)}"
            if is_out_of_memory(error):
                raise DeviceError(failed, *LESS_MEMORY) from error
            raise DeviceError(f"{failed}, sizes {global_size} {local_size}") from error
        self._device.observe(self.name, global_size, event)
        return event

    def over(self, n: int, group: int = GROUP_ITEMS, /, *more: int, **args: KernelArgument) -> Event:
        """Enqueue at least `n` work-items in whole groups; the kernel must ignore the items from n on.

        Groups may be smaller than `group`, where a device has only small ones: the kernel must work with any size.
        The size is fixed, because PoCL compiles a kernel again for each size that it chooses itself.

        Parameters
        ----------
        more : numbers of work-items in the other dimensions, in which groups have one.
        """
        group = min(group, self.item_group)
        return self(((n + group - 1) // group * group, *more), (group, *(1 for _ in more)), **args)

    def _mismatch(self, names: set[str]) -> str:
        missing = [name for name in self._names if name not in names]
        unknown = sorted(names - set(self._names))
        return f"kernel {self.name}: missing arguments {missing}, unknown arguments {unknown}"


def _max_group(kernel: pyopencl.Kernel, device: Device) -> int:
    """Return the largest work-group of a kernel: what its driver says, but no more than the device has."""
    import pyopencl as cl

    allowed = max(device.info.max_group, 1)
    if device.info.platform in _WITHOUT_LIMITS:
        return allowed
    try:
        limit = kernel.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, device.cl_device)
    except cl.Error:
        limit = 0
    return min(limit, allowed) if limit else allowed


def smoke_test(device: Device) -> tuple[float, float]:
    """Build and run a small kernel and check its numbers.

    Returns
    -------
    build_ms, run_ms : wall time of the build (the driver may have cached it), and device time of the kernel.

    Raises
    ------
    DeviceError : the kernel does not build or run, or its numbers are wrong.
    """
    import pyopencl as cl

    start = time.perf_counter()
    kernel = build(device, ("measure/smoke.cl",))["smoke"]
    build_ms = 1e3 * (time.perf_counter() - start)
    x = np.linspace(-3, 3, 1000, dtype=np.float32)
    source_buffer, result = device.alloc(x.nbytes), device.alloc(x.nbytes)
    try:
        to_device(device, source_buffer, x)
        with device.profiled():
            event = kernel((1024,), None, x=source_buffer, y=result, n=x.size)
        run_ms = elapsed_ms(event)
        computed = to_host(device, result, np.empty_like(x))
    except cl.Error as error:
        raise DeviceError(f"device {device.info} cannot run kernels: {first_line(error)}: update its driver") from None
    expected = np.array([math.exp(-v * v) + math.erfc(v) for v in x.tolist()])
    worst = float(np.max(np.abs(computed - expected) / expected))
    if not worst < SMOKE_TOLERANCE:
        raise wrong_numbers(device, f"off by {worst:.1e}")
    return build_ms, run_ms


def wrong_numbers(device: Device, what: str) -> DeviceError:
    """Return the error for a device whose results are wrong."""
    return DeviceError(f"device {device.info} computes wrong numbers ({what}): update its driver or use another device")


def _compiled(device: Device, text: str, options: list[str]) -> pyopencl.Program:
    """Return a built pyopencl program, from a cached binary if there is a good one; cl.Error if it does not build."""
    import pyopencl as cl

    path = binary_path(device.info, text, [*options, os.environ.get("PYOPENCL_BUILD_OPTIONS", "")])
    binary = None if path is None else load_binary(path)
    if binary is not None:
        with suppress(cl.Error):  # the driver may refuse the binary
            return cl.Program(device.context, [device.cl_device], [binary]).build(options)
    # False turns pyopencl's cache off; its annotation does not list this value.
    built = cl.Program(device.context, text).build(options, cache_dir=False)  # type: ignore[arg-type]
    if path is not None:
        store_binary(path, built.get_info(cl.program_info.BINARIES)[0])
    return built


def _read(name: str) -> str:
    return _read_outside(Path(name)) if Path(name).is_absolute() else _read_package(name)


def _read_outside(path: Path) -> str:
    """Text of a file that is not part of the package (a shape that was registered)."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: kernel source cannot be read ({first_line(error)}): check the folder") from None


@cache
def _read_package(name: str) -> str:
    try:
        return importlib.resources.files("clsplat_cl").joinpath(*name.split("/")).read_text(encoding="utf-8")
    except (OSError, ModuleNotFoundError):
        raise DeviceError(f"kernel source {name!r} is not in the installed package: reinstall clsplat") from None


def _literal(name: str, value: Define, real: Real) -> str:
    """Return the value of a define as OpenCL C text."""
    if isinstance(value, str):
        return value
    if isinstance(value, (int, np.integer)):
        return f"({int(value)})" if value < 0 else str(int(value))
    if not math.isfinite(value):
        raise ValueError(f"define {name}={value}: must be finite")
    text = repr(float(value)) if real == "double" else f"{np.float32(value)!s}f"
    return f"({text})" if value < 0 else text


def _build_error(device: Device, error: Exception, text: str, defines: Mapping[str, Define], real: Real) -> DeviceError:
    """Return the error of a build. text : what the compiler read."""
    log = str(error)
    if "unknown target CPU" in log:
        return DeviceError(f"device {device.info}: {BROKEN_POCL}")
    lines = [line.strip() for line in log.splitlines()]
    reason = next((line for line in lines if re.search(r"\berror\b\s*:", line, re.I)), first_line(error))
    reason = _with_file(reason, text)
    values = " ".join(f"{name}={value}" for name, value in defines.items())
    return DeviceError(f"kernels do not build on {device.info}: {reason} (real={real} {values})")


def _with_file(message: str, text: str) -> str:
    """Return a message with a file and its line instead of a line of the whole text.

    NVIDIA's compiler does not read `#line`.
    """
    found = re.match(r"<kernel>:(\d+)", message)
    if found is None:
        return message
    lines = text.splitlines()[: int(found[1])]
    for back, line in enumerate(reversed(lines)):
        if start := re.match(r'#line (\d+) "(.*)"', line):
            return f"{start[2]}:{int(start[1]) + back - 1}{message[found.end() :]}"
    return message
