"""Every option of every command with values that nobody should give: one line of error, or it works.

The lines come from click's lists of parameters (tests/support/hostile_flags.py), so that a new option is covered.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import click
import hostile_flags
import pytest
from clsplat_cli.main import COMMANDS, main
from hostile_flags import BASES, HOSTILE, Places, bounded, cases, fault_of, params_of, with_value
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

# Steps through the values of a quick run, which has few values of each option.
QUICK = {"train": 30, "compare": 59, "frontier": 59, "benchmark": 59}
SLOW_LINES = 30  # lines of a command that a slow test runs with all their work
WITH_OPTIONS = [name for name in COMMANDS if params_of(name)]
VALUES = st.one_of(
    st.sampled_from(HOSTILE),
    st.text(max_size=20),
    st.floats().map(str),
    st.integers(-(2**70), 2**70).map(str),
    st.lists(st.floats(width=32).map(str), max_size=4).map(",".join),
)
_numbers = count()


@pytest.fixture
def places(
    request: pytest.FixtureRequest, scene: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Places]:
    """Copies of the scene and the model: a line may write into them. The working folder is empty.

    The slow tests do the work, the others end where it would begin.
    """
    found = Places(tmp_path / "yard", tmp_path / "model", tmp_path / "place")
    shutil.copytree(scene, found.scene)
    shutil.copytree(model, found.model)
    found.prepare()
    monkeypatch.chdir(found.place / "cwd")
    slow = request.node.get_closest_marker("slow") is not None
    with bounded(monkeypatch, plan_only=not slow):
        yield found


def faults(command: str, places: Places, offset: int, step: int) -> list[str]:
    """Return the lines that end badly, each with what is wrong."""
    found = []
    for args in cases(command, offset, step):
        fault = fault_of([command, *places.fill(args, next(_numbers))])
        if fault is not None:
            found.append(f"{command} {' '.join(args)[:200]!r}: {fault}")
    return found


def test_every_command_has_a_line_that_works(places: Places) -> None:
    assert set(BASES) == set(COMMANDS)
    for command in ("info", "cameras", "convert", "blender-addon"):
        args = places.fill(BASES[command], next(_numbers))
        assert hostile_flags.run(command, *args).exit_code == 0, args


@pytest.mark.parametrize("command", WITH_OPTIONS)
def test_hostile_values_of_each_option(command: str, places: Places) -> None:
    assert faults(command, places, offset=3, step=QUICK.get(command, 12)) == []


@pytest.mark.slow
@pytest.mark.parametrize("command", WITH_OPTIONS)
def test_hostile_values_with_their_work(command: str, places: Places) -> None:
    step = max(sum(1 for _ in cases(command, 0, 1)) // SLOW_LINES, 1)
    assert faults(command, places, offset=1, step=step) == []


def hostile_lines(command: str, places: Places, data: st.DataObject, most: int) -> None:
    """Run a line with one to `most` hostile values, which hypothesis chooses and shrinks."""
    line = BASES[command]
    for param in data.draw(st.lists(st.sampled_from(params_of(command)), min_size=1, max_size=most, unique=True)):
        line = with_value(command, param, data.draw(VALUES), line)
    args = [command, *places.fill(line, next(_numbers))]
    assert fault_of(args) is None, args


@pytest.mark.parametrize("command", WITH_OPTIONS)
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_hostile_lines(command: str, places: Places, data: st.DataObject) -> None:
    hostile_lines(command, places, data, 3)


@pytest.mark.slow
@pytest.mark.parametrize("command", WITH_OPTIONS)
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_many_hostile_lines(command: str, places: Places, data: st.DataObject) -> None:
    hostile_lines(command, places, data, 4)


def test_a_fault_is_found(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rules find a traceback, a second line, a foreign flag and a control character."""
    found = main.get_command(click.Context(main), "devices")
    assert found is not None

    def end_with(action: object) -> str:
        monkeypatch.setattr(found, "callback", action)
        return fault_of(["devices"]) or ""

    def say(text: str) -> None:
        click.echo(text, err=True)
        raise SystemExit(1)

    assert "traceback" in end_with(lambda: 1 / 0)
    assert "no single line" in end_with(lambda: say("error: a\nb"))
    assert "names ['--cap-max']" in end_with(lambda: say("error: use --cap-max"))
    assert "control characters" in end_with(lambda: say("error: \x07"))
    assert "exit code 3" in end_with(lambda: exit(3))
    assert end_with(lambda: say("error: plain")) == ""
    monkeypatch.setattr(hostile_flags, "SECONDS", 0.1)
    monkeypatch.setattr(hostile_flags, "WAIT", 1)
    assert "0.1 s of the processor" in end_with(lambda: sum(1 for _ in count()))
    assert "longer than 1 s" in end_with(lambda: time.sleep(30))
