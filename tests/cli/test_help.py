"""`--help` and `--help-all` of every command, `clsplat` alone, and commands that do not exist."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys

import click
import pytest
from cli_runner import clsplat, error_of, flags_of, run
from clsplat_cli.command import OTHER, DocumentedCommand, SectionedCommand
from clsplat_cli.help_layout import TerminalFormatter, wrapped, write_examples
from clsplat_cli.main import COMMANDS, EXAMPLES, main

from clsplat.device.caches import USER_VARIABLE
from clsplat.rendering.tuning import SCHEDULE_VARIABLE

SCREEN = 60  # lines of a short help with its examples, at the 80 columns of click's runner
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


def documented(name: str) -> DocumentedCommand:
    command = command_named(name)
    assert isinstance(command, DocumentedCommand), f"{name} has no examples"
    return command


SECTIONED = [name for name in COMMANDS if isinstance(command_named(name), SectionedCommand)]


HELPS = [(), *((name,) for name in COMMANDS)]
HELPS = [(*words, "--help") for words in HELPS] + [(name, "--help-all") for name in SECTIONED]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_on_a_screen(name: str) -> None:
    text = clsplat(name, "--help")
    assert text.startswith(f"Usage: clsplat {name}")
    assert len(text.splitlines()) <= SCREEN


@pytest.mark.parametrize("columns", [80, 60])
@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_no_line_is_wider_than_the_terminal(
    words: tuple[str, ...], columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main(words, prog_name="clsplat")  # click's runner for tests would always take 80 columns
    text = capsys.readouterr().out
    assert "\nExamples:\n  clsplat " in text
    assert [line for line in text.splitlines() if len(line) > columns] == []
    assert re.findall(r".*(?:\w-|[ \t])$", text, re.M) == [], "a word is cut, or blanks end a line"
    assert "[default:\n" not in text


def test_the_program_lists_examples_and_exit_codes() -> None:
    text = clsplat("--help")
    assert all(f"\n  {command}\n" in text for command, _ in EXAMPLES)
    for code in (0, 1, 2, 130):
        assert re.search(rf"^  {code} +\S", text, re.M)


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_are_command_lines(name: str) -> None:
    """Each help shows at least one of its command. At 80 columns a line has room for each, and click accepts it."""
    command, text = documented(name), clsplat(name, "--help")
    assert any(line.startswith(f"clsplat {name}") for line, _ in command.examples)
    for line, meaning in command.examples:
        assert f"\n  {line}\n      {meaning.split()[0]}" in text
        assert re.fullmatch(r"[A-Z].*[.?]", meaning)
        program, other, *words = shlex.split(line)
        assert program == "clsplat"
        with command_named(other).make_context(other, words, parent=click.Context(main)):
            pass


@pytest.mark.parametrize("name", COMMANDS)
def test_other_commands_of_the_help_exist(name: str) -> None:
    named = documented(name).see_also
    assert named
    assert set(named) <= set(COMMANDS) - {name}
    assert clsplat(name, "--help").endswith(f"{named[-1]}\n")


def test_lines_end_at_blanks_or_else_at_commas_and_bars() -> None:
    assert wrapped("one two-three four  [default: 7]", 14) == ["one two-three", "four", "[default: 7]"]
    assert wrapped("four.  [default: 7]", 20) == ["four.  [default: 7]"]
    assert wrapped("run `a b` now", 8) == ["run", "`a b`", "now"]
    assert wrapped("in default,3dgs,ges,sss,sns", 14) == ["in default,", "3dgs,ges,sss,", "sns"]
    assert wrapped("[default: a default of many words]", 14) == ["[default: a", "default of", "many words]"]


def test_names_that_are_too_long_for_their_column_stand_alone() -> None:
    formatter = TerminalFormatter(width=24)
    formatter.write_dl([("-a", "one two three fours"), ("-b N", "five six"), ("--long [x|y|zz]", "seven")])
    assert formatter.getvalue().splitlines() == [
        "-a    one two three",
        "      fours",
        "-b N  five six",
        "--long [x|y|zz]",
        "      seven",
    ]


def test_variables_are_listed() -> None:
    text = clsplat("devices", "--help")
    assert re.findall(r"^  ([A-Z_]{5,})  ", text, re.M) == ["PYOPENCL_CTX", SCHEDULE_VARIABLE, USER_VARIABLE]


def test_a_long_command_line_goes_on_after_a_backslash() -> None:
    formatter = TerminalFormatter(width=36)
    write_examples(formatter, [("clsplat train SCENE -m MODEL --cap-max 9 --eval", "A run.")])
    assert formatter.getvalue() == (
        "Examples:\n  clsplat train SCENE \\\n          -m MODEL --cap-max 9 \\\n          --eval\n      A run.\n"
    )


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


@pytest.mark.parametrize(("words", "wanted"), [("clsplat tr", "train"), ("clsplat ", "view")])
def test_names_of_commands_are_completed(words: str, wanted: str) -> None:
    environment = os.environ | {"COMP_WORDS": words, "COMP_CWORD": "1", "_CLSPLAT_COMPLETE": "bash_complete"}
    done = subprocess.run(
        [sys.executable, "-c", "from clsplat_cli.main import main; main(prog_name='clsplat')"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"plain,{wanted}" in done.stdout.splitlines()
    assert done.stderr == ""


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


@pytest.mark.parametrize("command", ["compare", "frontier", "train", "partition"])
def test_help_names_only_flags_of_the_command(command: str) -> None:
    shown = run(command, "--help-all").output
    assert ("implies --eval" in " ".join(shown.split())) == ("--eval" in flags_of(command))
