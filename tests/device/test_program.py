"""Programs: joined sources, defines, caching, build errors; kernels: binding by name, scalars, launches."""

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsplat.device import program as program_module
from clsplat.device.device import BROKEN_POCL, Device, list_devices, open_device
from clsplat.device.program import (
    OPTIONS_VARIABLE,
    Parameter,
    _literal,
    build,
    build_text,
    parse_signatures,
    smoke_test,
    source,
)
from clsplat.errors import DeviceError

REAL = """
#if REAL_DOUBLE
typedef double real;
#else
typedef float real;
#endif
"""
AFFINE = (
    REAL
    + """
kernel void affine(
    global const real *restrict x,  // [n], (in) a comment with, commas
    global real *restrict y,        /* [n], out */
    const int n, real a,
    local real *scratch,            // [group]
    ulong shift)
{
    int i = get_global_id(0);
    scratch[get_local_id(0)] = a * (i < n ? x[i] : (real)0);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (i < n) y[i] = scratch[get_local_id(0)] + OFFSET + (real)(shift >> 32);
}
"""
)
EMPTY = "kernel void nothing(int n) { }"


def usable() -> list[str]:
    return [info.index for info in list_devices() if info.fault is None]


@pytest.fixture(scope="module", params=usable())
def device(request) -> Device:
    return open_device(request.param)


@pytest.fixture(autouse=True)
def warnings_are_errors(monkeypatch):
    monkeypatch.setenv(OPTIONS_VARIABLE, "-Werror")


def run_affine(device: Device, real: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the kernel's output and the expected output."""
    dtype = np.dtype(np.float64 if real == "double" else np.float32)
    x = np.linspace(-2, 5, n, dtype=dtype)
    xs, ys = device.alloc(x.nbytes), device.alloc(x.nbytes)
    cl.enqueue_copy(device.queue, xs, x)
    built = build_text(device, AFFINE, {"OFFSET": 1 / 255}, real)
    size = (-(-n // 64) * 64,)
    with device.profiled():
        event = built.affine(size, (64,), x=xs, y=ys, n=n, a=2, scratch=64 * dtype.itemsize, shift=3 << 32)
    y = np.empty_like(x)
    cl.enqueue_copy(device.queue, y, ys)
    event.wait()
    assert event.profile.end >= event.profile.start
    return y, 2 * x.astype(np.float64) + 1 / 255 + 3


@pytest.mark.parametrize(("real", "tolerance"), [("float", 1e-6), ("double", 1e-15)])
def test_kernel_binds_by_name_in_both_precisions(device, real, tolerance):
    if real == "double" and not device.has_fp64:
        pytest.skip("no double precision here")
    got, expected = run_affine(device, real, 1000)
    assert np.allclose(got, expected, rtol=tolerance, atol=tolerance)


def test_the_smoke_test_passes_and_detects_wrong_numbers(device, monkeypatch):
    build_ms, run_ms = smoke_test(device)
    assert build_ms >= 0
    assert run_ms >= 0
    head = "kernel void smoke(global const float *x, global float *y, int n) "
    inexact = "{ int i = get_global_id(0); if (i < n) y[i] = 1.0001f * (exp(-x[i] * x[i]) + erfc(x[i])); }"
    for body in ("{ y[0] = x[n - 1]; }", inexact):
        wrong = head + body
        monkeypatch.setattr(program_module, "build", lambda device, files, wrong=wrong: build_text(device, wrong))
        with pytest.raises(DeviceError, match="wrong numbers"):
            smoke_test(device)


def test_sources_are_joined_with_their_names():
    text = source("measure/smoke.cl", "measure/smoke.cl")
    assert text.count('#line 1 "measure/smoke.cl"\n') == 2
    assert text.count("kernel void smoke(") == 2


def test_missing_source_is_named():
    with pytest.raises(DeviceError, match=r"'shape/none\.clh'"):
        source("shape/none.clh")


def test_build_is_cached_by_files_defines_options_and_precision(device, monkeypatch):
    first = build(device, ("measure/smoke.cl",), {"A": 1})
    assert build(device, ("measure/smoke.cl",), {"A": 1}) is first
    assert build(device, ("measure/smoke.cl",), {"A": 2}) is not first
    if device.has_fp64:
        assert build(device, ("measure/smoke.cl",), {"A": 1}, "double") is not first
    monkeypatch.setenv(OPTIONS_VARIABLE, "-w")
    assert build(device, ("measure/smoke.cl",), {"A": 1}) is not first


def test_build_error_names_file_line_device_and_defines(device):
    text = '#line 1 "shape/odd.clh"\n\nkernel void f(int n) { n = undeclared; }\n'
    with pytest.raises(DeviceError) as caught:
        build_text(device, text, {"LANES": 16})
    message = str(caught.value)
    assert "\n" not in message
    for part in ("shape/odd.clh:2", "undeclared", device.info.name, "LANES=16", "real=float"):
        assert part in message


def test_a_line_of_the_whole_text_becomes_a_file_and_its_line(monkeypatch):
    """NVIDIA's compiler counts the lines of the text, and skips `#line`."""

    def refuse(*args):
        line = 1 + args[1].splitlines().index("second of b")
        raise cl.RuntimeError(f"<kernel>:{line}:28: error: unknown type")

    monkeypatch.setattr(cl, "Program", refuse)
    for text, place in (
        ('#line 1 "a.clh"\none\n#line 1 "b.cl"\n\nsecond of b\n', " b.cl:2:28: error: unknown type"),
        ("second of b\n", " <kernel>:5:28: error"),
    ):
        with pytest.raises(DeviceError) as caught:
            build_text(open_device(), text, {"LANES": 16})
        assert place in str(caught.value)


def test_unknown_cpu_is_named_as_the_broken_wheel(monkeypatch):
    def refuse(*args):
        raise cl.RuntimeError("error: unknown target CPU 'generic'")

    monkeypatch.setattr(cl, "Program", refuse)
    with pytest.raises(DeviceError) as caught:
        build_text(open_device(), EMPTY)
    assert BROKEN_POCL in str(caught.value)


def test_missing_double_precision_is_reported_before_building():
    class Single:
        has_fp64 = False
        info = "Anvil"

    with pytest.raises(DeviceError, match="Anvil has no double precision"):
        build_text(Single(), EMPTY, real="double")


def test_wrong_arguments_are_named(device):
    nothing = build_text(device, EMPTY)["nothing"]
    with pytest.raises(TypeError, match=r"kernel nothing: missing arguments \['n'\], unknown arguments \[\]"):
        nothing((1,), None)
    with pytest.raises(TypeError, match=r"missing arguments \[\], unknown arguments \['m'\]"):
        nothing((1,), None, n=1, m=2)
    with pytest.raises(TypeError, match="kernel nothing"):
        nothing((1,), None, n=device.alloc(4))
    with pytest.raises(TypeError, match="kernel nothing"):
        nothing((1,), None, n=1 << 40)


def test_refused_launch_names_kernel_and_device(device):
    nothing = build_text(device, EMPTY)["nothing"]
    with pytest.raises(DeviceError, match="kernel nothing on") as caught:
        nothing((3,), (2,), n=1)
    assert "\n" not in str(caught.value)


def test_empty_launch_runs_nothing(device):
    built = build_text(device, "kernel void set(global int *y) { y[0] = 1; }")
    buffer = device.alloc(4)
    cl.enqueue_fill_buffer(device.queue, buffer, np.int32(5), 0, 4)
    built.set((0,), (64,), y=buffer).wait()
    got = np.zeros(1, np.int32)
    cl.enqueue_copy(device.queue, got, buffer)
    assert got[0] == 5


def test_unknown_kernel_names_the_known_ones(device):
    built = build_text(device, EMPTY)
    assert built["nothing"] is built.nothing
    with pytest.raises(KeyError, match="nothing"):
        built["something"]
    with pytest.raises(AttributeError, match="no kernel 'something'"):
        _ = built.something


def test_signatures_are_read_in_the_house_style():
    text = """
    // kernel void hidden(int x)
    __kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void a(
        __global const float4* restrict p, constant int *table, const uint n, real r) {}
    kernel void b(void) {}
    void helper(global int *x) {}
    """
    assert parse_signatures(text, "double") == {
        "a": (
            Parameter("p", "buffer"),
            Parameter("table", "buffer"),
            Parameter("n", "scalar", np.dtype(np.uint32)),
            Parameter("r", "scalar", np.dtype(np.float64)),
        ),
        "b": (),
    }
    assert parse_signatures(text, "float")["a"][3].dtype == np.float32


def test_parameters_follow_the_defines():
    text = """
    kernel void f(
        int n,
    #if WITH_DEPTH
        global float *depth,
    #endif
    #ifdef ROW_SKEW
        real lr,
    #endif
        int m
    ) {}
    """
    for defines, names in (
        ({"WITH_DEPTH": 0}, "nm"),
        ({"WITH_DEPTH": 1}, ["n", "depth", "m"]),
        ({"WITH_DEPTH": 0, "ROW_SKEW": 0}, ["n", "lr", "m"]),
    ):
        assert [parameter.name for parameter in parse_signatures(text, "float", defines)["f"]] == list(names)
    with pytest.raises(DeviceError, match="'WITH_DEPTH', which is not a define"):
        parse_signatures(text, "float")


def test_unreadable_signatures_are_refused():
    with pytest.raises(DeviceError, match=r"kernel f: parameter 'float4 v'"):
        parse_signatures("kernel void f(int n, float4 v) {}", "float")
    with pytest.raises(DeviceError, match="two definitions"):
        parse_signatures("kernel void f(int n) {} kernel void f(int m) {}", "float")


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_float_defines_keep_their_value(value):
    single = _literal("X", value, "float").strip("()")
    assert single.endswith("f")
    assert "." in single or "e" in single
    assert np.float32(single[:-1]) == np.float32(value)
    assert float(_literal("X", value, "double").strip("()")) == value


def test_other_defines():
    assert _literal("X", -3, "float") == "(-3)"
    assert _literal("X", True, "float") == "1"
    assert _literal("X", "a + b", "float") == "a + b"
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="X"):
            _literal("X", value, "float")
