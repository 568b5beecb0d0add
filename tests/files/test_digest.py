"""Digests of photos: they depend on the size, and on the start, the middle and the end of a file."""

from __future__ import annotations

from pathlib import Path

from clsplat.files.digest import file_digest


def test_size_start_middle_and_end_change_a_digest(tmp_path: Path) -> None:
    size, file = 1 << 17, tmp_path / "photo"
    digests = set()
    for at in (None, 0, size // 2, size - 1):
        content = bytearray(size)
        if at is not None:
            content[at] = 1
        file.write_bytes(content)
        digests.add(file_digest(file))
    file.write_bytes(bytes(size + 2))
    digests.add(file_digest(file))
    assert len(digests) == 5
    (tmp_path / "mask").write_bytes(b"")
    assert file_digest(file) != file_digest(file, tmp_path / "mask") != file_digest(tmp_path / "mask", file)
