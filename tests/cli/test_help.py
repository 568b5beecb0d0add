"""`--help` and `--help-all` of every command, `clsplat` alone, and commands that do not exist."""

from __future__ import annotations

import re

import click
import pytest
from cli_runner import clsplat, error_of, run
from clsplat_cli.command import OTHER, SectionedCommand
from clsplat_cli.main import COMMANDS, main

SCREEN = 45  # lines of a short help, at 80 columns
# Words with an underscore that a user meets: names of files, folders and lens models.
_NAMES = (
    r"images_4|camera_path\.json|transforms_train\.json|point_cloud|per_view\.json|results_train\.json|"
    r"\w*[A-Z]_[A-Z]\w*|iteration_N"
)


def command_named(name: str) -> click.Command:
    command = main.get_command(click.Context(main), name)  # type: ignore[attr-defined]
    assert command is not None
    return command


def options_of(name: str) -> list[click.Option]:
    return [param for param in command_named(name).params if isinstance(param, click.Option)]


SECTIONED = [name for name in COMMANDS if isinstance(command_named(name), SectionedCommand)]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_on_a_screen(name: str) -> None:
    text = clsplat(name, "--help")
    assert text.startswith(f"Usage: clsplat {name}")
    assert len(text.splitlines()) <= SCREEN
    assert max(map(len, clsplat(name, "--help").splitlines())) <= 140  # a list of choices is not broken


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_a_sentence_without_internals(name: str) -> None:
    for option in options_of(name):
        text = (option.help or "").partition("  [")[0]
        assert re.fullmatch(r"[^a-z].*\.|(\w|-)+: .*\.", text, re.S), f"{option.opts}: {text!r}"
        if isinstance(option.type, (click.IntRange, click.FloatRange)):
            assert option.metavar, f"{option.opts}: INTEGER RANGE is no word for a user"
    text = clsplat(name, "--help-all" if name in SECTIONED else "--help")
    assert re.findall(r"\d\.\d{7,}", text) == []
    words = re.findall(r"[\w.]*\w_\w[\w.]*", text)
    assert [word for word in words if not re.search(_NAMES, word)] == []


def test_train_shows_a_dozen_options_and_all_on_request() -> None:
    short, whole = clsplat("train", "--help"), clsplat("train", "--help-all")
    shown = re.findall(r"^  (?:-\w, )*(--[a-z-]+)", short, re.M)
    assert 8 <= len(shown) <= 16
    assert {"--iterations", "--cap-max", "--eval", "--resume", "--help-all"} <= set(shown)
    assert "--sghmc-friction" not in short
    assert "transforms_train.json" not in short
    assert "transforms_train.json" in whole
    headings = re.findall(r"^(\w.*):$", whole, re.M)
    assert headings[:2] == ["Common options", "Photos and test views"]
    assert headings.index("Training") < headings.index("Loss")


@pytest.mark.parametrize("name", SECTIONED)
def test_help_all_lists_every_option_once(name: str) -> None:
    whole = clsplat(name, "--help-all")
    listed = re.findall(r"^  (-.*?)(?:  |$)", whole, re.M)
    for option in options_of(name):
        flag = option.opts[-1]
        assert len([line for line in listed if re.search(rf"(?<![\w-]){flag}(?![\w-])", line)]) == 1, flag
    assert f"\n{OTHER}:" not in whole


def test_the_program_alone_prints_its_help() -> None:
    result = run()
    assert result.exit_code == 2
    assert "\n  train " in result.stderr
    assert "error:" not in result.stderr


@pytest.mark.parametrize(("wrong", "right"), [("trian", "train"), ("evaluate", "eval"), ("reconstuct", "reconstruct")])
def test_the_nearest_command_is_named(wrong: str, right: str) -> None:
    assert f"no command '{wrong}'; did you mean {right}?" in error_of(wrong, code=2)


def test_no_command_is_near() -> None:
    assert error_of("xyz", code=2) == "error: no command 'xyz' (see: clsplat --help)"
