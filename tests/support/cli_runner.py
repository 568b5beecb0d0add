"""Helpers that run the command line in tests, and sizes of the small capture (tests/conftest.py)."""

from __future__ import annotations

from click.testing import CliRunner, Result
from clsplat_cli.main import main

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
    return errors[0]
