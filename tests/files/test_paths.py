"""Files that a command names: links that lead in a circle, devices, and files that are read and written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from clsplat.errors import InputError, OutputError
from clsplat.files.existing import refuse_existing
from clsplat.files.json_file import describe, read_json
from clsplat.files.real_path import real_path
from clsplat.files.whole_file import read_whole

ROOT = Path(__file__).resolve().parents[2]


def test_a_link_that_leads_to_itself_has_a_path(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to("loop")
    assert real_path(loop / "below").name == "below"
    assert real_path(loop).is_absolute()


@pytest.mark.parametrize("package", ["clsplat", "cli"])
def test_no_path_is_resolved_in_another_way(package: str) -> None:
    """Path.resolve raises RuntimeError for links that lead in a circle, before Python 3.13."""
    found = [
        path for path in (ROOT / package).rglob("*.py") for line in path.read_text().splitlines() if _resolves(line)
    ]
    assert found == []


def _resolves(line: str) -> bool:
    return ".resolve()" in line and "__file__" not in line and "library.resolve()" not in line and "`" not in line


@pytest.mark.skipif(os.devnull != "/dev/null", reason="this system has no devices in /dev")
def test_a_device_is_never_read() -> None:
    """Another device, /dev/zero, would fill the memory."""
    with pytest.raises(InputError, match=r"^/dev/null: cannot be read \(a device, not a file\)"):
        read_json("/dev/null", "a config.json")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_pipe_of_the_shell_is_read() -> None:
    """Shells make such a file of `--config <(echo ...)`."""
    reading, writing = os.pipe()
    os.write(writing, b'{"iterations": 3}')
    os.close(writing)
    try:
        assert read_whole(Path(f"/dev/fd/{reading}")) == b'{"iterations": 3}'
    finally:
        os.close(reading)


@pytest.mark.parametrize(("value", "text"), [(float("nan"), "nan"), (float("-inf"), "-inf"), (2.5, "a number")])
def test_numbers_in_messages(value: float, text: str) -> None:
    assert describe(value) == text


def test_two_outputs_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(OutputError, match="is named for two files"):
        refuse_existing([tmp_path / "a.json", tmp_path / "link" / "a.json"])


def test_an_input_is_never_replaced(tmp_path: Path) -> None:
    photo = tmp_path / "photo.png"
    photo.write_bytes(b"the only copy")
    with pytest.raises(OutputError, match="is a photo of the scene"):
        refuse_existing([photo], overwrite=True, inputs=[photo])
