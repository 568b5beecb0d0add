"""Sequences of commands: each one works on what the commands before it have written.

Between the commands, files are deleted, damaged, replaced or renamed, and runs are stopped by signals.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from fuzzing import damage

REAL = ("kitchen", "fox")  # scenes of real photos, to be reduced
SCENES = ("scene", "scene", "transforms/transforms.json", "blender", "kitchen", "fox")
TINY = ["--iterations", "6", "--cap-max", "300", "--checkpoint-interval", "4", "-q"]
PHOTOS = {
    "scene": "scene/images/*.png",
    "transforms/transforms.json": "transforms/images/*",
    "blender": "blender/**/*.png",
    "kitchen": "kitchen/images/*",
    "fox": "fox/images/*",
}
MODEL_FILES = ("config.json", "cameras.json", "checkpoint.npz", "log.jsonl", "point_cloud/*/*.ply")
PATHS = (["orbit"], ["ellipse"], ["spiral"], ["interpolate"], ["interpolate", "--closed"])
PATHS += (["interpolate", "--keys", "view_001,view_003,view_005"], ["files/path.json"])


@dataclass(frozen=True)
class Change:
    """A change of files between two commands.

    Attributes
    ----------
    kind : "delete", "damage", "append" a byte, "rename", or "link": move the file and leave a link.
    files : pattern of the files below the workspace; one to three of them are changed.
    """

    kind: str
    files: str

    def apply(self, root: Path, rng: np.random.Generator) -> None:
        found = sorted(path for path in root.glob(self.files) if path.is_file())
        for index in rng.permutation(len(found))[: int(rng.integers(1, 4))]:
            path = found[index]
            if self.kind == "delete":
                path.unlink()
            elif self.kind == "damage":
                damage({path: path.read_bytes()}, rng)
            elif self.kind == "append":
                path.write_bytes(path.read_bytes() + b"\0")
            else:
                moved = path.with_name(f"moved-{path.name}")
                path.rename(moved)
                if self.kind == "link":
                    path.symlink_to(moved.name)


T = TypeVar("T")
KINDS = ("delete", "damage", "append", "rename", "link")


@dataclass(frozen=True)
class Command:
    """A command: its arguments, whether it must succeed, and after how many seconds which signal stops it."""

    args: list[str]
    succeeds: bool = False
    stopped: tuple[float, int] | None = None


Step = Command | Change


def sequence(rng: np.random.Generator) -> list[Step]:
    """Return a random sequence; the last step is a command."""
    return _KINDS[rng.integers(len(_KINDS))](rng)


def _photos_change(rng: np.random.Generator) -> list[Step]:
    scene = _one(rng, SCENES)
    resume = ["train", "--resume", "-m", "out"]
    if rng.random() < 0.3:
        resume.append("--allow-changed-photos")
    if rng.random() < 0.6:
        resume += ["--iterations", "9"]
    last = _one(
        rng, (resume, resume, ["eval", "out"], ["prune", "out", "-o", "out.ply"], ["train", scene, "-m", "out"])
    )
    return [_trained(rng, scene), Change(_one(rng, KINDS), PHOTOS[scene]), Command(last)]


def _resumed(rng: np.random.Generator) -> list[Step]:
    number = _one(rng, ("7", "9", "12", "6", "3", "0"))
    longer = Command(["train", "--resume", "-m", "model", "--iterations", number, "-q"], int(number) > 6)
    return [longer, Command(["eval", "model"], True), Command(["train", "--resume", "-m", "model", "-q"], True)]


def _stopped(rng: np.random.Generator) -> list[Step]:
    long = ["train", "scene", "-m", "out", "--iterations", "400", "--cap-max", "300", "-q"]
    number = _one(rng, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    stopped = Command(long, stopped=(float(rng.uniform(0.3, 5.0)), number))
    return [stopped, Command([*long[:1], "--resume", "-m", "out", "-q"]), Command(["eval", "out"])]


def _measured(rng: np.random.Generator) -> list[Step]:
    scene = _one(rng, SCENES)
    views = _one(rng, ("test", "train", "all"))
    return [
        _trained(rng, scene, "--eval"),
        Command(["eval", "out", "-s", scene, "--set", views, "--json", "out.json"], True),
        Command(["render", "out", "-s", scene, "--set", views, "-o", "frames"], True),
    ]


def _along_a_path(rng: np.random.Generator) -> list[Step]:
    args = ["render", _one(rng, ("model", "files/skew.ply")), "--path", *_one(rng, PATHS), "--size", "16x12"]
    args += ["--frames", "3", *_one(rng, (["-o", "out"], ["--video", "out.mp4"], ["-o", "out", "--depth", "--alpha"]))]
    saved = [*args, "--save-path", "path.json"]
    return [Command(saved), Command(["render", "model", "--path", "path.json", "-o", "again", "--size", "16x12"])]


def _pruned(rng: np.random.Generator) -> list[Step]:
    whole = ["--whole"] if rng.random() < 0.5 else []
    return [
        Command(["prune", "model", "-o", "out.ply", "--tolerance", "2", *whole, "-q"], True),
        Command(["eval", "out.ply", "-s", "scene"], True),
        Command(["convert", "out.ply", _one(rng, ("out.spz", "out.splat", "back.ply")), "--approximate"], True),
        Command(["info", "out.ply"], True),
    ]


def _converted(rng: np.random.Generator) -> list[Step]:
    suffixes = (".ply", ".spz", ".splat")
    first, last = f"out{_one(rng, suffixes)}", f"back{_one(rng, suffixes)}"
    version = ["--spz-version", "4"] if first.endswith(".spz") and rng.random() < 0.5 else []
    steps: list[Step] = [Command(["convert", "model", first, "--approximate", *version, "-q"], True)]
    if rng.random() < 0.3:
        steps.append(Change(_one(rng, KINDS), first))
    steps.append(Command(["convert", first, last, "--approximate", "-q"], len(steps) == 1))
    return [*steps, Command(["eval", last, "-s", "scene"], len(steps) == 2)]


def _cameras(rng: np.random.Generator) -> list[Step]:
    formats = {"transforms": "t.json", "colmap": "c", "colmap-text": "x", "cameras": "cameras.json"}
    first, last = (_one(rng, tuple(formats)) for _ in range(2))
    source = _one(rng, (*SCENES, "model", "files/path.json"))
    # 3DGS's cameras.json has no distortion, and the lenses of transforms.json have some.
    is_sound = source != "files/path.json" and not (first == "cameras" and source.startswith("transforms"))
    written = Command(["cameras", source, formats[first], "--format", first], is_sound)
    again = Command(["cameras", formats[first], f"again-{formats[last]}", "--format", last])
    used = ["render", "model", "-o", "frames", "--size", "16x12"]
    used += ["--cameras", "cameras.json"] if first == "cameras" else ["-s", formats[first]]
    return [written, again, Command(used), Command(["info", formats[first]])]


def _model_damaged(rng: np.random.Generator) -> list[Step]:
    commands: Sequence[list[str]] = (
        ["train", "--resume", "-m", "model"],
        ["train", "--resume", "-m", "model", "--iterations", "9"],
        ["eval", "model"],
        ["render", "model", "-o", "out", "--path", "orbit", "--frames", "2"],
        ["info", "model"],
        ["prune", "model", "-o", "out.ply"],
        ["convert", "model", "out.spz", "--approximate"],
        ["cameras", "model", "out.json"],
        ["compare", "scene", "-o", "model", "--iterations", "4"],
    )
    damaged = Change(_one(rng, ("damage", "damage", "delete", "link")), f"model/{_one(rng, MODEL_FILES)}")
    return [damaged, Command(_one(rng, commands))]


def _budget_damaged(rng: np.random.Generator) -> list[Step]:
    search = ["train", "scene", "-m", "out", *TINY, "--budget", "auto"]
    stopped = (float(rng.uniform(1.0, 8.0)), int(signal.SIGTERM))
    begun = Command(search, stopped=stopped if rng.random() < 0.7 else None)
    change = Change(
        _one(rng, ("damage", "delete")), _one(rng, ("out/budget.json", "out/budget/**/*", "out/config.json"))
    )
    return [begun, change, Command(["train", "--resume", "-m", "out", "-q"])]


_KINDS: tuple[Callable[[np.random.Generator], list[Step]], ...] = (
    _photos_change,
    _resumed,
    _stopped,
    _measured,
    _along_a_path,
    _pruned,
    _converted,
    _cameras,
    _model_damaged,
    _model_damaged,
    _budget_damaged,
)


def _trained(rng: np.random.Generator, scene: str, *more: str) -> Command:
    args = ["train", scene, "-m", "out", *TINY, *more, *(["--seed", "3"] if rng.random() < 0.2 else [])]
    return Command([*args, *(["-r", "8"] if scene in REAL else [])], True)


def _one(rng: np.random.Generator, values: Sequence[T]) -> T:
    return values[int(rng.integers(len(values)))]
