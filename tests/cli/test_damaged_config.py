"""A damaged config.json: each command that reads it names the file and the field in one line, or succeeds."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from cli_runner import run
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from clsplat.scenes.options import READING_OPTIONS
from clsplat.training.config import TrainConfig

# Values of every kind that JSON has, and some that only Python writes and reads (NaN, Infinity, halves of characters).
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from([0, -1, 3, 10**400]),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["", "a", "\0", "\ud800", "../..", "x" * 5000, "sfm", "\u202e"]),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
)
MISSING = object()  # stands for the removal of a key
KINDS: dict[tuple[str, ...], type] = {
    ("scene",): dict,
    **{("scene", key): str for key in ("path", "images", "masks", "alpha", "test_list")},
    ("scene", "resolution"): int,
    ("scene", "test_every"): int,
    ("scene", "eval"): bool,
    ("scene", "test_names"): list,
    ("scene", "photos"): dict,
}
QUICK = ("info", "convert", "train --resume", "train --config")
ALL = (*QUICK, "cameras", "render", "eval", "prune", "clean", "view")


@pytest.fixture
def model(model_folder: Path, tmp_path: Path) -> Path:
    """Return a copy of the model of the small capture, beside a copy of its sound config.json."""
    shutil.copy(model_folder / "config.json", tmp_path / "sound.json")
    return Path(shutil.copytree(model_folder, tmp_path / "model"))


def keys_of(values: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the paths of all values: (), ("config",), ("config", "seed"), ..."""
    parts = [(part,) for part in values]
    return [(), *parts, *((part, key) for (part,) in parts if isinstance(values[part], dict) for key in values[part])]


def damaged(values: dict[str, Any], place: tuple[str, ...], value: Any) -> Any:
    """Return the values with another one in a place, or without it."""
    if not place:
        return [] if value is MISSING else value
    copy = json.loads(json.dumps(values))
    parent = copy
    for key in place[:-1]:
        parent = parent[key]
    if value is MISSING:
        del parent[place[-1]]
    else:
        parent[place[-1]] = value
    return copy


def arguments(command: str, model: Path, folder: Path) -> list[object]:
    """Return a quick command line that reads the model's config.json and writes new files."""
    scene = json.loads((model.parent / "sound.json").read_text())["scene"]["path"]
    new = folder / str(sum(1 for _ in folder.iterdir()))
    return {
        "info": ["info", model],
        "convert": ["convert", model, new.with_suffix(".ply"), "--shape", "skew-normal"],
        "train --resume": ["train", "--resume", "-m", model, "-q"],
        "train --config": ["train", scene, "-m", new, "--config", model / "config.json", "--iterations", 1, "-q"],
        "cameras": ["cameras", model, new.with_suffix(".json")],
        "render": ["render", model, "-o", new, "-q"],
        "eval": ["eval", model, "-q"],
        "clean": ["clean", model, "-o", new, "-q"],
        "prune": ["prune", model, "-o", new.with_suffix(".ply"), "-q"],
        "view": ["view", model, "--port", 0, "-q"],
    }[command]


def check(command: str, model: Path, folder: Path, place: tuple[str, ...], value: Any) -> None:
    """Damage the file, run the command, and check its end."""
    stored = json.loads((model.parent / "sound.json").read_text())
    (model / "config.json").write_text(json.dumps(damaged(stored, place, value)))
    result = run(*arguments(command, model, folder))
    shown = f"{command}, {place} = {value!r}: {result.output}"
    if result.exit_code == 0:
        return
    assert isinstance(result.exception, SystemExit), f"{shown} {result.exception!r}"
    assert result.exit_code == 1, shown
    lines = [line for line in result.stderr.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, shown
    assert lines[0].startswith("error: "), shown
    assert "Traceback" not in result.output, shown
    if place in KINDS and value not in (None, MISSING) and not isinstance(value, KINDS[place]):
        assert "config.json: " in lines[0], shown
        assert ".".join(place) in lines[0], shown


def keys() -> list[tuple[str, ...]]:
    """Return the places of all values in a config.json."""
    scene = dict.fromkeys(("path", "test_names", "photos", *READING_OPTIONS))
    return keys_of({"config": TrainConfig().to_json(), "scene": scene})


def try_all_kinds(commands: tuple[str, ...], model: Path, examples: int) -> None:
    """Check commands with many damages. The same examples are tried each time."""
    outputs = model.parent / "outputs"
    outputs.mkdir()
    # The keys of the scene matter to all commands, those of the options to few.
    places = st.sampled_from(keys()) | st.sampled_from([place for place in keys() if place[:1] != ("config",)])

    @settings(
        max_examples=examples,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(command=st.sampled_from(commands), place=places, value=st.just(MISSING) | VALUES)
    def holds(command: str, place: tuple[str, ...], value: Any) -> None:
        # More iterations are no damage: --resume then trains on.
        assume(not (place == ("config", "iterations") and type(value) is int and value > 0))
        check(command, model, outputs, place, value)

    holds()


def test_damaged_values_end_in_one_line(model: Path) -> None:
    try_all_kinds(QUICK, model, 40)


@pytest.mark.slow
def test_every_command_survives_many_damaged_values(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    from clsplat.viewer.session import ViewingSession

    def end(self: ViewingSession) -> None:
        raise KeyboardInterrupt  # as Ctrl-C does, when the server would begin to serve

    monkeypatch.setattr(ViewingSession, "run", end)
    try_all_kinds(ALL, model, 400)


@pytest.mark.parametrize("command", ["info", "train --resume", "eval", "render"])
@pytest.mark.parametrize(
    ("key", "value"), [("resolution", "a"), ("test_names", 3), ("path", "a\0b"), ("alpha", [1]), ("images", {})]
)
def test_the_message_names_file_and_field(model: Path, command: str, key: str, value: Any) -> None:
    (model.parent / "outputs").mkdir()
    check(command, model, model.parent / "outputs", ("scene", key), value)
    error = run(*arguments(command, model, model.parent / "outputs")).stderr
    assert f"{model / 'config.json'}: " in error
    assert f"scene.{key} is " in error
