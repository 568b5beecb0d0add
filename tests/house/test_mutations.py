"""Mutations of the sources: all of them still apply, and the runner finds which changes the tests notice."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from mutating import (
    CAUGHT,
    EQUIVALENT,
    ROOT,
    SURVIVED,
    Laboratory,
    Mutation,
    Result,
    ScratchCopy,
    WarmPytest,
    calls_of,
    faults_of,
    read_tables,
    share_caught,
    wider_tests,
)

LEAST = 150  # mutations


def test_all_mutations_apply() -> None:
    """A change of the sources that removes an old text needs another mutation in its place."""
    assert faults_of(read_tables()) == []


def test_every_part_of_the_sources_has_mutations() -> None:
    mutations = read_tables()
    assert len(mutations) >= LEAST
    kernels = {path.relative_to(ROOT).as_posix() for path in (ROOT / "cl").rglob("*.cl*") if path.suffix != ".md"}
    # A file of one call each, which the mutations of the file below change too.
    assert kernels - {mutation.file for mutation in mutations} == {"cl/shape/gaussian.clh"}
    packages = {path.name for path in (ROOT / "clsplat").iterdir() if (path / "__init__.py").is_file()}
    assert packages - {mutation.package for mutation in mutations} == set()
    assert all(len(mutation.equivalent.split()) > 5 for mutation in mutations if mutation.equivalent), "gives a reason"


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"old": "no such text"}, "has the old text 0 times, expected once"),
        ({"old": "import"}, "times, expected once"),
        ({"old": "import", "nth": 1000}, "times, expected 1000"),
        ({"new": "TIMEOUT = 600.0"}, "changes nothing"),
        ({"file": "tests/support/no_such.py"}, "does not exist"),
        ({"tests": ("tests/house/no_such.py -k some",)}, "no_such.py -k some does not exist"),
        ({"tests": ()}, "names no tests"),
    ],
)
def test_a_fault_of_the_table_is_named(changes: dict[str, object], fault: str) -> None:
    sound = Mutation(
        "name", "tests/support/mutating.py", "TIMEOUT = 600.0", "TIMEOUT = 1.0", "a word", ("tests/house/test_docs.py",)
    )
    assert faults_of([sound]) == []
    (found,) = faults_of([replace(sound, **changes)])
    assert fault in found
    assert faults_of([sound, sound]) == ["name: the name occurs twice"]


def test_one_call_for_each_choice_and_one_for_whole_files() -> None:
    assert calls_of(["a.py", "b.py -k one and not two", "c.py"]) == [
        ["b.py", "-k", "one and not two"],
        ["a.py", "c.py"],
    ]
    mutation = Mutation(
        "a", "clsplat/files/lock.py", "", "", "", ("tests/files/test_lock.py", "tests/files/test_disk.py -k x")
    )
    assert "tests/files/test_disk.py" in wider_tests(mutation)
    assert "tests/files/test_lock.py" not in wider_tests(mutation)


SOURCE = "def double(x):\n    return 2 * x\n\n\ndef half(x):\n    return x / 2\n"
TESTS = """import os, signal
from small import double, half

def test_double():
    if double(1) > 100:
        os.kill(os.getpid(), signal.SIGSEGV)
    assert double(3) == 6

def test_waits():
    while half(2) == 3:
        pass

def test_fails_always():
    assert False
"""


@pytest.fixture
def laboratory(tmp_path: Path) -> Iterator[Laboratory]:
    """A repository with a module of two functions in the folder `root`, and its scratch copy."""
    root = tmp_path / "root"
    (root / "tests" / "small").mkdir(parents=True)
    (root / "small.py").write_text(SOURCE)
    (root / "tests" / "small" / "test_small.py").write_text(TESTS)
    subprocess.run(["git", "init", "-q", str(root)], check=True)
    (tmp_path / "scratch").mkdir()
    runner = WarmPytest(tmp_path, ("nice",), 60.0, ["pytest", "xdist", "_hypothesis_pytestplugin"])
    yield Laboratory(ScratchCopy(tmp_path / "scratch", runner, root))
    runner.close()


WRONG = Mutation("wrong", "small.py", "2 * x", "3 * x", "", ("tests/small/test_small.py -k not fails",))


def outcome(laboratory: Laboratory, **changes: object) -> tuple[str, str]:
    result = laboratory.run(replace(WRONG, **changes))
    return result.outcome, result.by


def test_a_failing_test_counts_if_it_passes_without_the_mutation(laboratory: Laboratory, tmp_path: Path) -> None:
    assert outcome(laboratory) == (CAUGHT, "tests/small/test_small.py::test_double")
    assert outcome(laboratory, old="x / 2", new="x / 4") == (SURVIVED, "")
    assert outcome(laboratory, equivalent="for a reason") == (EQUIVALENT, "for a reason")
    with pytest.raises(ValueError, match=r"wrong: .*test_fails_always fails without the mutation, too"):
        outcome(laboratory, tests=("tests/small/test_small.py -k always",))
    for root in ("root", "scratch/tree"):
        assert (tmp_path / root / "small.py").read_text() == SOURCE


@pytest.mark.slow
def test_crashes_and_hangs_are_noticed(laboratory: Laboratory) -> None:
    assert "ended with -11" in outcome(laboratory, new="1000 * x")[1]
    laboratory.copy.pytest.timeout = 2.0
    assert outcome(laboratory, old="x / 2", new="x + 1")[1].endswith("no end within 2 s")
    laboratory.copy.pytest.timeout = 60.0
    with pytest.raises(ValueError, match="selects no test"):
        outcome(laboratory, tests=("tests/small/test_small.py -k nothing",))


def test_equivalent_mutations_do_not_count() -> None:
    results = [Result("a", "files", outcome) for outcome in (CAUGHT, SURVIVED, EQUIVALENT, CAUGHT)]
    assert share_caught(results) == (2, 3)
