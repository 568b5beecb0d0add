"""Damaged files: every reader refuses them in one line or reads a valid result. benchmarks/fuzz.py tries many more."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from fuzz_readers import READERS
from fuzzing import campaign

INPUTS = 15  # inputs of each reader


def test_a_share_of_every_reader_s_inputs() -> None:
    """The seed is fixed, so that every run tests the same inputs."""
    readers = list(READERS)
    with ThreadPoolExecutor(2) as pool:
        results = [
            result
            for part in pool.map(lambda part: campaign(part, INPUTS), (readers[::2], readers[1::2]))
            for result in part
        ]
    assert {result.inputs for result in results} == {INPUTS}
    assert [fault for result in results for fault in result.faults] == []
    assert all(result.refused > INPUTS / 5 for result in results), "the damage is too slight"


PLANTED = """
import os
from clsplat.errors import InputError
from fuzzing import ROOM
from fuzz_readers import Sample

def read(folder):
    if not (folder / "a").is_file() or (folder / "a").read_bytes() != b"sound":
        {body}

READERS = {{"planted": Sample(lambda folder: (folder / "a").write_bytes(b"sound"), read)}}
"""


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("bytearray(2 * ROOM)", "MemoryError"),
        pytest.param("os._exit(7)", "ended (7)", marks=pytest.mark.slow),
        pytest.param("raise ValueError('no')", "ValueError: no", marks=pytest.mark.slow),
        pytest.param("raise InputError('two\\nlines')", "several lines", marks=pytest.mark.slow),
        pytest.param("while True: pass", "took longer", marks=pytest.mark.slow),
    ],
)
def test_faults_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, said: str) -> None:
    (tmp_path / "planted.py").write_text(PLANTED.format(body=body))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (result,) = campaign(["planted"], 2, table="planted")
    assert result.inputs == 2
    assert len(result.faults) == 2
    assert all(said in fault["fault"] for fault in result.faults)
