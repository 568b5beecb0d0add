"""Scenes with what reading them says, and runs that recorded less of them than today."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

from cli_runner import run

from clsplat.scenes.scene import Scene, load_scene


def scene_and_warnings(folder: Path, **arguments: object) -> tuple[Scene, str]:
    """Return a scene, and all that reading it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load_scene(folder, **arguments)  # type: ignore[arg-type]
    return scene, " ".join(str(one.message) for one in caught)


def go_on_without_record(model: Path, key: str, message: str) -> None:
    """Measure a model and train it on as one whose run recorded nothing for `key`. Reading must not warn of it."""
    file = model / "config.json"
    values = json.loads(file.read_text(encoding="utf-8"))
    values["scene"][key] = None
    file.write_text(json.dumps(values), encoding="utf-8")
    for command in (("eval", model), ("train", "--resume", "-m", model, "--iterations", "60")):
        said = run(*command)
        assert said.exit_code == 0, said.output
        assert message not in said.stderr
