"""Running the command line in tests, and the small capture that it runs on."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from clsplat_cli.main import main

from clsplat.scenes.demo.scene import write_capture

WIDTH, HEIGHT, N_VIEWS = 48, 36, 10
TEST_NAMES = ["view_000.png", "view_008.png"]  # every 8th of ten
CAP, ITERATIONS = 400, 60
# Small and short, with every part of the strategy at work.
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

_kept: dict[str, Path] = {}


def small_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture's folder, made once for the whole run; read only."""
    if "capture" not in _kept:
        _kept["capture"] = write_capture(tmp_path_factory.mktemp("small") / "yard", WIDTH, HEIGHT, N_VIEWS)
    return _kept["capture"]


def small_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of the capture, trained with --eval by the command line; read only."""
    if "model" not in _kept:
        model = tmp_path_factory.mktemp("small") / "model"
        clsplat(
            "train",
            small_capture(tmp_path_factory),
            "-m",
            model,
            "--eval",
            "--save-iterations",
            "20,40",
            *SHORT,
        )
        _kept["model"] = model
    return _kept["model"]


def run(*args: object) -> Result:
    """`clsplat ARGS` in this process."""
    return CliRunner().invoke(main, [str(arg) for arg in args], prog_name="clsplat")


def clsplat(*args: object) -> str:
    """Standard output of a `clsplat ARGS` that must end well."""
    result = run(*args)
    assert result.exit_code == 0, result.output
    return result.stdout


def error_of(*args: object, code: int = 1) -> str:
    """The message of a `clsplat ARGS` that must fail: one line, no traceback, nothing on standard output."""
    result = run(*args)
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code == code, result.output
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert errors == lines[-1:], result.output
    assert "Traceback" not in result.output
    assert result.stdout == ""
    return errors[0]
