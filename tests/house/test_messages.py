"""Messages name only options that the command has: a search of the sources, and errors raised in each command."""

from __future__ import annotations

import ast
import pickle
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from cli_runner import FLAG, error_of, flags_of, foreign_flags
from clsplat_cli.main import COMMANDS, main

import clsplat.errors
from clsplat.errors import FEWER_SPLATS, OTHER_DEVICE, SMALLER_IMAGES, ClsplatError, InputError, Remedy

ROOT = Path(__file__).parents[2]
TRAINING = ("train", "compare", "frontier", "benchmark")
ALL_WITH_MODELS = ("render", "eval", "view", "prune", "clean")
# Files whose messages name options in their text, and the commands that can raise them. All other files of clsplat/
# name options as `Remedy`; each command shows its own.
NAMED_IN = {
    "cameras/make_path.py": ("render",),
    "blocks/train.py": ("train", "partition"),
    "compression/search.py": ("train",),
    "compression/state.py": ("train",),
    "files/existing.py": tuple(name for name in COMMANDS if "--overwrite" in flags_of(name)),
    "files/video.py": ("render",),
    "models/convert.py": ("convert",),
    "models/evaluation.py": ("eval",),
    "models/info.py": ("info",),
    "models/model.py": ALL_WITH_MODELS,
    "models/render.py": ("render",),
    "scenes/changed_photos.py": ("train",),
    "scenes/reconstruct/model_scene.py": ("train",),
    "scenes/reconstruct/panoramas.py": ("reconstruct",),
    "scenes/reconstruct/photo_files.py": ("reconstruct",),
    "scenes/reconstruct/reconstruct.py": ("reconstruct", "train"),
    "training/average.py": ("train",),
    "training/checkpoint.py": ("train",),
    "training/exposure.py": ("train",),
    "training/initialise.py": TRAINING,
    "training/optim/rules.py": ("train",),
    "training/stages.py": ("train",),
    "training/stored_run.py": ("train",),
    "training/extension.py": ("train",),
    "viewer/access.py": ("train", "view"),
    "viewer/listen.py": ("train", "view"),
}
# Files of the command line that several commands share. The others belong to the commands that they define.
SHARED = {
    "options.py": ("train", "compare", "frontier", "benchmark", "render", "eval", "view"),
    "comparison_options.py": ("compare", "frontier", "benchmark"),
    "path_options.py": ("render",),
    "models.py": ("render", "view"),
    "budget.py": ("train",),
    "blocks.py": ("train", "partition"),
    "main.py": (),
}


def messages(path: Path) -> Iterator[tuple[int, str]]:
    """Yield all texts of several words, without docstrings, helps, `Remedy` and HTML; insertions are "X"."""
    tree = ast.parse(path.read_text())
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            skipped.add(node.value)
        elif isinstance(node, ast.keyword) and node.arg == "help":
            skipped.update(ast.walk(node))
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Remedy":
            skipped.update(node.args)
        elif isinstance(node, ast.JoinedStr):
            skipped.update(node.values)
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        elif isinstance(node, ast.JoinedStr):
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
        else:
            continue
        if " " in text and "<" not in text:
            yield node.lineno, text


def commands_of(path: Path) -> tuple[str, ...]:
    if path.name in SHARED:
        return SHARED[path.name]
    return tuple(name for name, (where, _) in COMMANDS.items() if where.split(":")[0].endswith(f".{path.stem}"))


@pytest.mark.parametrize("folder", ["clsplat", "cli"])
def test_messages_name_options_of_the_commands_that_raise_them(folder: str) -> None:
    wrong, seen = [], set()
    for path in sorted((ROOT / folder).rglob("*.py")):
        file = path.relative_to(ROOT / folder).as_posix()
        for line, text in messages(path):
            if not FLAG.search(text):
                continue
            seen.add(file)
            commands = NAMED_IN.get(file, ()) if folder == "clsplat" else commands_of(path)
            foreign = {flag for name in commands or ("",) for flag in foreign_flags(text, name)}
            wrong += [f"{file}:{line}: {flag} is no option of all of {commands}" for flag in sorted(foreign)]
    assert not wrong, "\n".join(wrong)
    if folder == "clsplat":
        assert set(NAMED_IN) - seen == set(), "files that no longer name an option"


def test_remedies_name_options_that_exist() -> None:
    everything = set().union(*map(flags_of, COMMANDS))
    known = [value for value in vars(clsplat.errors).values() if isinstance(value, Remedy)]
    assert len(known) >= 3
    flags = {flag for remedy in known for flag in remedy.flags}
    for path in (ROOT / "clsplat").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Remedy":
                text, *named = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
                assert not FLAG.search(text), f"{path.name}: {text}: functions have no flags"
                flags |= set(named)
    assert {flag.split()[0] for flag in flags} <= everything


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("kind", ["memory", "device", "driver", "error"])
def test_every_command_shows_its_own_remedies(command: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyopencl as cl

    raised = {
        "memory": MemoryError(),
        "device": cl.MemoryError("clEnqueue", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE),
        "driver": cl.LogicError("clFinish", cl.status_code.INVALID_VALUE, "bad"),
        "error": InputError("it failed", FEWER_SPLATS, SMALLER_IMAGES, OTHER_DEVICE, Remedy("try again")),
    }[kind]

    def fail(*args: object, **values: object) -> None:
        raise raised

    found = main.get_command(click.Context(main), command)
    assert found is not None
    monkeypatch.setattr(found, "parse_args", lambda ctx, args: [])
    monkeypatch.setattr(found, "invoke", fail)
    said = error_of(command)  # checks the flags
    assert ("(--device)" in said) == (kind != "memory" and "--device" in flags_of(command))
    assert ("(--cap-max" in said) == (kind != "driver" and "--cap-max" in flags_of(command))


def test_functions_show_no_flags_and_errors_can_be_pickled() -> None:
    error = InputError("it failed", FEWER_SPLATS, Remedy("try again"))
    assert str(error) == "it failed: use fewer splats or try again"
    assert error.for_command(flags_of("train")) == "it failed: use fewer splats (--cap-max) or try again"
    assert error.for_command(flags_of("bench")) == "it failed: use fewer splats (--splats) or try again"
    assert error.for_command(flags_of("render")) == "it failed: try again"
    assert ClsplatError("plain").for_command(()) == "plain"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
