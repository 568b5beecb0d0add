"""Files of splats are known by their content, whatever their name, and written by their ending."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import packed_ply
import pytest
from reference.scenes import random_splats

from clsplat.errors import InputError
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


def test_what_is_no_file_of_splats_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0 no splats")
    with pytest.raises(InputError, match=r"a.jpg: not a PLY file"):
        Splats.load(tmp_path / "a.jpg")
    for path in (tmp_path, tmp_path / "none.splat", tmp_path / "none.spz"):
        with pytest.raises(InputError, match="cannot be read"):
            Splats.load(path)
