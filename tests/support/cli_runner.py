"""Helpers that run the command line in tests, and sizes of the small capture (tests/conftest.py)."""

from __future__ import annotations

import re

import click
from click.testing import CliRunner, Result
from clsplat_cli.main import COMMANDS, main

WIDTH, HEIGHT, N_VIEWS = 48, 36, 10
TEST_NAMES = ["view_000.png", "view_008.png"]  # every 8th of ten
CAP, ITERATIONS = 400, 60
# A small, short training that uses every part of the strategy.
SHORT = [
    "--iterations",
    str(ITERATIONS),
    "--cap-max",
    str(CAP),
    "--sh-degree",
    "1",
    "--densify-interval",
    "10",
]
# Options of the run behind the fixture `model_folder`. Such a short run has a skew only if it names one.
MODEL_RUN = ["--eval", "--save-iterations", "20,40", "--shape", "skew-normal", *SHORT]


def run(*args: object) -> Result:
    """Run `clsplat ARGS` in this process."""
    return CliRunner().invoke(main, [str(arg) for arg in args], prog_name="clsplat")


def clsplat(*args: object) -> str:
    """Return the standard output of a `clsplat ARGS` that must succeed."""
    result = run(*args)
    assert result.exit_code == 0, result.output
    return result.stdout


def error_of(*args: object, code: int = 1) -> str:
    """Return the message of a `clsplat ARGS` that must fail: one line, no traceback, nothing on standard output."""
    result = run(*args)
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code == code, result.output
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert errors == lines[-1:], result.output
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert foreign_flags(errors[0], str(args[0])) == []
    return errors[0]


FLAG = re.compile(r"(?<![\w/.-])-(?:-[a-z][a-z-]*|[a-z])(?![\w-])")


def last_iteration(shown: str, iterations: int) -> int:
    """Return the highest iteration that lines of progress show, such as "120/100000"; 0 if they show none.

    The first line comes after a time, so its iteration depends on the speed of the machine.
    """
    return max((int(done) for done in re.findall(rf"(\d+)/{iterations}\b", shown)), default=0)


def flags_of(command: str) -> set[str]:
    """Return all options of a command."""
    found = main.get_command(click.Context(main), command)
    params = found.params if found else []
    return {"--help", *(flag for param in params for flag in (*param.opts, *param.secondary_opts))}


def foreign_flags(message: str, command: str) -> list[str]:
    """Return the flags of a message that the command lacks. `clsplat train --eval` names an option of train.

    What is quoted may come from the user. "(see: ...)" is click's.
    """
    text = re.sub(r"'[^']*'|`(?:pip|dask) [^`]*`|\(see: .*?\)|clsplat devices", "", message)
    foreign = []
    for part in re.split(r"(?=clsplat [a-z-]+ )", text):
        named = re.match(r"clsplat ([a-z-]+) ", part)
        known = flags_of(named[1] if named and named[1] in COMMANDS else command)
        foreign += [flag for flag in FLAG.findall(part) if flag not in known]
    return foreign
