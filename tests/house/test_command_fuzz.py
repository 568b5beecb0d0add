"""Random command lines: each ends well. benchmarks/fuzz_commands.py tries thousands."""

from __future__ import annotations

from pathlib import Path

import command_fuzz
import pytest
from clsplat_cli.main import COMMANDS
from command_fuzz import Outcome, changed_files, judge, run_lines, states_of
from command_lines import command_line
from scenes_data import scene_folder

LINES = 30  # lines of the default run


def test_a_share_of_the_lines() -> None:
    """The seed is fixed, so that every run tests the same lines."""
    outcomes = list(run_lines(range(LINES), seed=0))
    assert sorted(outcome.number for outcome in outcomes) == list(range(LINES))
    assert [(outcome.number, outcome.args, outcome.faults) for outcome in outcomes if outcome.faults] == []
    assert sum(outcome.code == 0 for outcome in outcomes) > LINES / 8, "the lines are too odd"
    assert sum(outcome.code == 1 for outcome in outcomes) > LINES / 8, "the lines are too tame"


@pytest.mark.slow
def test_more_lines() -> None:
    data = scene_folder("kitchen").parent
    outcomes = list(run_lines(range(LINES, LINES + 150), seed=0, workers=2, data=data))
    assert [(outcome.number, outcome.args, outcome.faults) for outcome in outcomes if outcome.faults] == []


def test_every_command_is_tried() -> None:
    assert {command_line(0, number).command for number in range(2000)} == {*COMMANDS, "(none)"}


@pytest.mark.parametrize(
    ("code", "output", "fault"),
    [
        (1, "Traceback (most recent call last):\nerror: x\n", "Traceback"),
        (3, "error: x\n", "exit code 3"),
        (-11, "", "exit code -11"),
        (1, "error: x\nmore\n", "does not end"),
        (1, "error: x\nerror: y\n", "does not end"),
        (2, "", "does not end"),
        (0, "error: x\n", "ends with 0"),
        (0, "\x1b[31m\n", "control characters"),
        (0, "RuntimeWarning: overflow encountered in multiply\n", "overflow"),
    ],
)
def test_faults_are_found(code: int, output: str, fault: str) -> None:
    faults = judge(Outcome(0, "train", ["train"], code, 0.1, 1, False, [], output))
    assert any(fault in found for found in faults), faults


def test_a_changed_input_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    photo = tmp_path / "scene" / "a.png"
    photo.write_bytes(b"one")
    before = states_of(tmp_path)
    photo.write_bytes(b"other")
    assert changed_files(before, states_of(tmp_path)) == ["scene/a.png"]


def test_a_failure_of_the_harness_is_a_fault(tmp_path: Path) -> None:
    """The template does not exist."""
    outcome = command_fuzz._run_or_report(3, 0, tmp_path / "nothing", tmp_path)
    assert outcome.number == 3
    assert "the harness failed" in outcome.faults[0]
    assert "FileNotFoundError" in outcome.faults[0]
