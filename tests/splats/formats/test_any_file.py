"""Files of splats are known by their content, whatever their name, and written by their ending."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import packed_ply
import pytest
from reference.scenes import random_splats

from clsplat.errors import InputError, OutputError
from clsplat.models.info import inspect
from clsplat.splats.splats import Splats


def some(shape: str = "gaussian") -> Splats:
    arrays = {name: values.astype(np.float32) for name, values in random_splats(7, 12, 1).items()}
    return Splats("skew-normal", arrays).as_shape(shape)


@pytest.mark.parametrize("ending", [".ply", ".spz"])
def test_the_content_decides(tmp_path: Path, ending: str) -> None:
    some().save(tmp_path / f"a{ending}")
    wanted = Splats.load(tmp_path / f"a{ending}")
    for name in ("b.ply", "b.bin", "b"):
        (tmp_path / name).write_bytes((tmp_path / f"a{ending}").read_bytes())
        np.testing.assert_array_equal(Splats.load(tmp_path / name).mean, wanted.mean)


@pytest.mark.parametrize("ending", [".splat", ".glb", ".spz", ".sog", ".html", ".ply"])
@pytest.mark.parametrize("kind", [".ply", ".spz", ".sog", ".glb"])
def test_a_wrong_ending_does_not_matter(tmp_path: Path, kind: str, ending: str) -> None:
    """A .splat has no mark: a file of any other format would be read as some splats, if its length fits."""
    some().save(tmp_path / f"a{kind}")
    expected = Splats.load(tmp_path / f"a{kind}")
    renamed = (tmp_path / f"a{kind}").rename(tmp_path / f"b{ending}")
    np.testing.assert_array_equal(Splats.load(renamed).mean, expected.mean)


def test_an_openusd_file_with_another_ending_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"#usda 1.0")
    with pytest.raises(InputError, match=r"a.ply: is an OpenUSD file, which needs its ending: rename it to a.usd"):
        Splats.load(tmp_path / "a.ply")


def test_compressed_ply_needs_no_special_name(tmp_path: Path) -> None:
    packed_ply.write(tmp_path / "model.ply", packed_ply.some(300, 2))
    assert len(Splats.load(tmp_path / "model.ply")) == 300


def test_the_ending_decides_what_is_written(tmp_path: Path) -> None:
    starts = {"a.ply": b"ply\n", "a.spz": b"\x1f\x8b", "a.SPZ": b"\x1f\x8b", "a.point_cloud": b"ply\n"}
    for name, start in starts.items():
        some().save(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    some().save(tmp_path / "a.splat")
    assert (tmp_path / "a.splat").stat().st_size == 12 * 32
    for name in ("b.spz", "b.splat"):
        with pytest.raises(InputError, match="files hold Gaussians, not skew-normal splats"):
            some("skew-normal").save(tmp_path / name)


@pytest.mark.parametrize("name", ["room.ksplat", "room.lcc"])
def test_formats_that_are_not_read_have_a_way(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"1234")
    with pytest.raises(InputError, match=rf"{name}: .* `splat-transform {name} room.ply`"):
        Splats.load(tmp_path / name)
    with pytest.raises(InputError, match=rf"{name}: .* `splat-transform {name} room.ply`"):
        inspect(tmp_path / name)


def test_what_is_no_file_of_splats_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0 no splats")
    with pytest.raises(InputError, match=r"a.jpg: not a PLY file"):
        Splats.load(tmp_path / "a.jpg")
    for path in (tmp_path, tmp_path / "none.splat", tmp_path / "none.spz"):
        with pytest.raises(InputError, match="cannot be read"):
            Splats.load(path)


WRITTEN_ENDINGS = [".ply", ".splat", ".spz", ".sog", ".glb", ".usdc"]


def in_double(splats: Splats, **changed: np.ndarray) -> Splats:
    """Return the splats in double precision with other values of some fields."""
    arrays = {name: values.astype(np.float64) for name, values in splats.to_numpy().items()}
    return splats.with_arrays(arrays | changed)


def double_ply(path: Path, splats: Splats) -> None:
    """Write Gaussians as a PLY file in double precision, as programs for maps do."""
    splats.save(path)
    head, _, _ = path.read_bytes().partition(b"end_header\n")
    columns = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    single = np.frombuffer(path.read_bytes()[len(head) + 11 :], "<f4").reshape(len(splats), len(columns))
    rows = single.astype("<f8")
    rows[:, [columns.index(name) for name in ("x", "y", "z")]] = splats.mean
    path.write_bytes(head.replace(b"float", b"double") + b"end_header\n" + rows.tobytes())


@pytest.mark.parametrize("ending", WRITTEN_ENDINGS)
def test_coordinates_of_a_map_are_not_rounded_in_silence(tmp_path: Path, ending: str) -> None:
    if ending == ".usdc":
        pytest.importorskip("pxr")
    near = in_double(some())
    far = near.with_arrays(near.to_numpy() | {"mean": near.mean + np.array([500_000.0, 4_500_000.0, 100.0])})
    with pytest.raises(InputError, match=r"not written: its splats are around \(500000, 4\.5e\+06, \d"):
        far.save(tmp_path / f"a{ending}")
    assert not (tmp_path / f"a{ending}").exists()
    near.save(tmp_path / f"a{ending}")


def test_coordinates_of_a_map_are_warned_of(tmp_path: Path) -> None:
    near = some()
    double_ply(tmp_path / "near.ply", near)
    assert Splats.load(tmp_path / "near.ply").mean.dtype == np.float64
    rows = (tmp_path / "near.ply").read_bytes()
    head, _, body = rows.partition(b"end_header\n")
    values = np.frombuffer(body, "<f8").reshape(len(near), -1).copy()
    values[:, :3] += (500_000.0, 4_500_000.0, 100.0)
    (tmp_path / "far.ply").write_bytes(head + b"end_header\n" + values.tobytes())
    with pytest.warns(UserWarning, match=r"far\.ply: its splats are around .*subtract a point near them"):
        assert len(Splats.load(tmp_path / "far.ply")) == len(near)


@pytest.mark.parametrize("ending", WRITTEN_ENDINGS)
def test_values_that_float32_does_not_hold_are_not_written(tmp_path: Path, ending: str) -> None:
    if ending == ".usdc":
        pytest.importorskip("pxr")
    splats = some()
    mean = splats.mean.astype(np.float64)
    mean[3, 1] = 1e300
    with pytest.raises(InputError, match=r"splats: mean\[3, 1\]: value is inf, must be finite"):
        in_double(splats, mean=mean).save(tmp_path / f"a{ending}")
    assert not (tmp_path / f"a{ending}").exists()


@pytest.mark.parametrize("ending", [".glb", ".usdc"])
def test_a_scale_that_float32_does_not_hold_is_not_written(tmp_path: Path, ending: str) -> None:
    if ending == ".usdc":
        pytest.importorskip("pxr")
    splats = some()
    log_scale = splats.log_scale.copy()
    log_scale[2, 0] = 90.0
    with pytest.raises(InputError, match=r"splat 2 has the scale e\^90, which float32 does not hold"):
        splats.with_arrays(splats.to_numpy() | {"log_scale": log_scale}).save(tmp_path / f"a{ending}")
    assert not (tmp_path / f"a{ending}").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_usd_file_needs_a_name_in_utf_8(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    with pytest.raises(OutputError, match=r"bad.*: usd-core takes names in UTF-8 only") as caught:
        some().save(os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff.usdc"))
    assert str(caught.value).isprintable()
