"""Random command lines for every command, made of the options that the command has, and files for them to read.

An option that is added to a command is tried without a change here. A line depends only on its number and the seed.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
from cli_runner import clsplat
from clsplat_cli.main import COMMANDS, main
from command_sequences import REAL, Command, Step, sequence
from fuzz_readers import make_blender, make_compact, make_path, make_photographs, make_transforms, small_splats

from clsplat.files.images import write_png
from clsplat.scenes.demo.scene import write_capture
from clsplat.splats.formats.dot_splat import write_splat
from clsplat.splats.formats.spz import write_spz
from clsplat.splats.splats import Splats

SEQUENCES = 0.15  # share of the lines that are the end of a sequence of commands
# How often a command is tried. Commands that take long or serve until they are stopped are rarer.
SHARES = {
    "devices": 0.2,
    "blender-addon": 0.3,
    "demo": 0.1,
    "reconstruct": 0.15,
    "view": 0.1,
    "bench": 0.3,
    "compare": 0.3,
    "frontier": 0.3,
    "benchmark": 0.3,
    "train": 2.0,
}
# Options that keep a run short. They may be given again with other values; the last value counts.
SHORT = {
    "train": ["--iterations", "6", "--cap-max", "300"],
    "compare": ["--iterations", "4", "--cap-max", "200", "--seeds", "0"],
    "frontier": ["--iterations", "4", "--cap-max", "150,200", "--seeds", "0"],
    "benchmark": ["--iterations", "4", "--cap-max", "200", "--seeds", "0"],
    "demo": ["--iterations", "4", "--cap-max", "200", "--width", "32", "--views", "4"],
    "bench": ["--splats", "300", "--width", "64", "--height", "48", "--steps", "1"],
    "render": ["--size", "40x30"],
    "prune": ["--iterations", "2"],
}
SCENES = ("scene", "transforms", "blender", "transforms/transforms.json", "photos", *REAL)
MODELS = ("model", "files/skew.ply", "files/gaussian.ply", "files/compact.ply", "files/a.spz", "files/a.splat")
OTHERS = (
    "model/config.json",
    "files",
    "files/zero.ply",
    "files/points.ply",
    "files/cameras.json",
    "files/path.json",
    "files/config.json",
    "files/test.txt",
    "files/photo.png",
    "files/text.txt",
    "files/empty",
    "scene/images",
    "scene/sparse/0",
    "precious",
    "missing",
    "missing/deeper",
    ".",
    "..",
    "",
    "/proc/nope",
    "link",
    "\udcff\udcfe",
    "é" * 200,
    "a\nb",
    "\x1b[31mred",
)
# No absolute path but /proc: a command that runs as root may create all others.
OUTPUTS = (
    "out",
    "out/deep/er",
    "out.ply",
    "out.spz",
    "out.splat",
    "out.json",
    "out.mp4",
    "out.zip",
    "out.html",
    "precious",
    "precious/note.txt",
    "precious/picture.png",
    "precious/model.ply",
    "precious/film.mp4",
    "precious/values.json",
    "precious/page.html",
    "scene",
    "scene/inside",
    "photos/inside",
    "files/photo.png/below",
    "missing/out",
    "",
    "/proc/nope/out",
    "link",
    "é" * 200,
    "\udcff.ply",
    "a\nb",
)
NUMBERS = ("0", "1", "2", "3", "7", "-1", "-5", "0.5", "1e-3", "1e300", "-1e300", "1e-300", "nan", "inf", "-inf")
NUMBERS += ("1e3", "0x10", "99999999999999999999", "2147483648", "１２", "0,5", "", " 3", "--", "1_0")
WORDS = (
    "",
    "x",
    "é",
    "a\nb",
    "\0",
    "../..",
    "/",
    "%s",
    "{}",
    "a" * 400,
    "images",
    "cpu",
    "gpu",
    "0:0",
    "\x1b[31m",
    "-",
)
LISTS = ("1", "1,2", "2 4", "0", ",", "", "1,,2", "nan", "-1", "99999999999", "1,x", "3dgs", "sss,sns", "all")
SIZES = ("16x12", "1x1", "0x0", "-1x5", "axb", "100000x100000", "40", "", "1e3x2", "0.5,0.5,0.5", "1,1,1", "0:1", "2:1")
# Values that the options are made for. An option that is not here gets a value of its type.
SANE = {
    "--iteration": ("6",),
    "--images": ("images",),
    "--device": ("cpu", "0:0"),
    "--masks": ("none",),
    "--path": ("orbit", "ellipse", "spiral", "interpolate"),
    "--keys": ("0,3,5",),
    "--systems": ("3dgs,3d-hgs", "default"),
    "--preset": ("3dgs", "sss"),
    "--quality": ("draft", "best"),
    "--test-list": ("files/test.txt",),
    "--config": ("files/config.json",),
    "--cameras": ("files/cameras.json", "files/path.json"),
    "--add": ("out",),
    "--wheels": ("files",),
    "--init": ("points", "random", "files/skew.ply"),
    "--video": ("out.mp4",),
    "--save-path": ("out.json",),
    "--report": ("out.html",),
    "--json": ("out.json",),
    "--save-iterations": ("2,4",),
    "--test-iterations": ("3",),
    "--seeds": ("0", "1,2"),
    "--cap-max": ("100", "150"),
    "--size": ("16x12",),
    "--depth-range": ("1:5", "1,5"),
    "--background": ("1,0,0",),
    "--host": ("127.0.0.1",),
}
SANE_OUTPUTS = {
    "convert": ("out.ply", "out.spz", "out.splat"),
    "clean": ("out.ply", "out", "out.spz"),
    "prune": ("out.ply", "out"),
    "cameras": ("out", "out.json"),
    "blender-addon": ("out.zip",),
}
OUTPUT_NAMES = {"-o", "--output", "--video", "--save-path", "--report", "--save-renders", "--json", "--paths", "out"}
_HOSTILE_ENVIRONMENT = (
    {"COLUMNS": "1"},
    {"TERM": "dumb"},
    {"HOME": "/proc/nope", "XDG_CACHE_HOME": "/proc/nope"},
    {"CLSPLAT_SCHEDULE": "foo"},
    {"PYOPENCL_CTX": "7"},
    {"TMPDIR": "/proc/nope"},
    {"LANG": "C", "LC_ALL": "C"},
)


@dataclass
class Line:
    """One command line, with the steps that come before it in a sequence.

    Attributes
    ----------
    args : arguments after `clsplat`. environment : additional variables. damaged : inputs that are to be damaged.
    before : steps that come first, in the same folder. succeeds : whether the line must end with exit code 0.
    """

    args: list[str]
    environment: dict[str, str] = field(default_factory=dict)
    damaged: list[str] = field(default_factory=list)
    before: list[Step] = field(default_factory=list)
    succeeds: bool = False

    @property
    def command(self) -> str:
        return next((arg for arg in self.args if arg in COMMANDS), "(none)")

    @property
    def all_args(self) -> list[str]:
        """Arguments of all commands of the sequence."""
        return [arg for step in self.before if isinstance(step, Command) for arg in step.args] + self.args


def write_inputs(root: Path, data: Path | None) -> None:
    """Write the folders and files that the lines name.

    Parameters
    ----------
    data : folder of the real scenes `kitchen` and `fox`; None if it is not there.
    """
    write_capture(root / "scene", 32, 24, 8)
    shutil.copytree(root / "scene", root / "set" / "truck")
    for name, make in (("transforms", make_transforms), ("blender", make_blender), ("photos", make_photographs)):
        (root / name).mkdir()
        make(root / name)
    clsplat(
        "train",
        root / "scene",
        "-m",
        root / "model",
        "--eval",
        "--shape",
        "skew-normal",
        *SHORT["train"],
        "--checkpoint-interval",
        "4",
    )
    files, precious = root / "files", root / "precious"
    files.mkdir()
    small_splats().save(files / "skew.ply")
    small_splats("gaussian").save(files / "gaussian.ply")
    make_compact(files)
    (files / "model.ply").rename(files / "compact.ply")
    arrays = {name: values[:0] for name, values in small_splats().to_numpy().items()}
    Splats("skew-normal", arrays).save(files / "zero.ply")
    write_spz(files / "a.spz", small_splats("gaussian"))
    write_splat(files / "a.splat", small_splats("gaussian"))
    make_path(files)
    shutil.copy(root / "transforms" / "points.ply", files)
    shutil.copy(root / "model" / "cameras.json", files)
    shutil.copy(root / "model" / "config.json", files)
    (files / "test.txt").write_text("view_000.png\n", encoding="utf-8")
    (files / "text.txt").write_text("not what you expect\n", encoding="utf-8")
    (files / "empty").touch()
    write_png(files / "photo.png", np.zeros((9, 9, 3), np.uint8))
    precious.mkdir()
    for name in ("note.txt", "film.mp4", "page.html", "model.ply"):
        (precious / name).write_text("the only copy\n", encoding="utf-8")
    (precious / "values.json").write_text(json.dumps({"precious": True}), encoding="utf-8")
    write_png(precious / "picture.png", np.zeros((9, 9, 3), np.uint8))
    (root / "link").symlink_to("missing/target")
    for name in REAL:
        if data is not None and (data / name).is_dir():
            shutil.copytree(data / name, root / name, copy_function=shutil.copyfile)


def command_line(seed: int, number: int) -> Line:
    """Return the line with this number."""
    rng = np.random.default_rng([seed, number])
    if rng.random() < 0.03:
        return Line(_odd_line(rng))
    if rng.random() < SEQUENCES:
        *before, last = sequence(rng)
        assert isinstance(last, Command)
        return Line(last.args, before=before, succeeds=last.succeeds)
    names = list(COMMANDS)
    shares = np.array([SHARES.get(name, 1.0) for name in names])
    name = str(rng.choice(names, p=shares / shares.sum()))
    params = main.get_command(click.Context(main), name).params
    sane = rng.random() < 0.65  # values that the options are made for; files may be damaged all the same
    line = Line([name, *SHORT.get(name, [])])
    for param in params:
        is_argument = isinstance(param, click.Argument)
        if (is_argument or param.required) and rng.random() < 0.97:
            for _ in range(int(rng.integers(1, 3)) if param.nargs == -1 else 1):
                line.args += [*([] if is_argument else [param.opts[-1]]), _path(name, param, rng, sane)]
    options = [param for param in params if isinstance(param, click.Option) and not param.is_eager]
    for place in rng.permutation(len(options))[: int(rng.integers(0, 6))]:
        line.args += _option(name, options[place], rng, sane or rng.random() < 0.6)
    if name == "train" and rng.random() < 0.2:
        line.args = ["train", "--resume", "-m", "model", *line.args[line.args.index("train") + 1 :]]
        line.args = [arg for arg in line.args if arg not in SCENES]
    if name in ("render", "eval", "clean", "prune") and rng.random() < 0.7 and "-s" not in line.args:
        line.args += ["-s", str(rng.choice(["scene", "scene", "kitchen", "transforms", "fox"]))]
        if (
            "-r" not in line.args
            and "--resolution" not in line.args
            and name in ("eval", "clean", "prune")
            and line.args[-1] in REAL
        ):
            line.args += ["-r", "8"]
    if name in ("train", "render") and rng.random() < 0.8 and not {"-o", "-m", "--output"} & set(line.args):
        line.args += ["-o", "out"]
    if name == "train" and set(REAL) & set(line.args) and not {"-r", "--resolution"} & set(line.args):
        line.args += ["-r", "8"]
    if rng.random() < 0.35:
        line.damaged = [arg for arg in line.args if arg in (*SCENES, *MODELS, *OTHERS[1:11])]
    if rng.random() < 0.04:
        line.environment = dict(_HOSTILE_ENVIRONMENT[rng.integers(len(_HOSTILE_ENVIRONMENT))])
    return line


def place_of(name: str) -> str:
    """Return the folder of the workspace that an input lies in."""
    return name.split("/", 1)[0]


def _odd_line(rng: np.random.Generator) -> list[str]:
    lines: Sequence[list[str]] = (
        [],
        ["--help"],
        ["-h"],
        ["--version"],
        ["trian", "scene"],
        ["info", "--help"],
        ["train", "--help"],
        ["--device", "cpu", "info"],
        ["info", "--nonsense"],
        ["render"],
        ["", ""],
        ["info", "--", "--help"],
        ["convert", "files/skew.ply"],
        ["TRAIN", "scene"],
        ["train", "scene", "scene", "-m", "out"],
    )
    return list(lines[rng.integers(len(lines))])


def _option(command: str, option: click.Option, rng: np.random.Generator, sane: bool) -> list[str]:
    name = str(rng.choice([*option.opts, *option.secondary_opts]))
    if option.is_flag:
        return [name]
    kind = option.type
    known = next((SANE[spelling] for spelling in option.opts if spelling in SANE), None)
    if sane and known:
        return [name, str(rng.choice(known))]
    if isinstance(kind, click.Path):
        return [name, _path(command, option, rng, sane)]
    if isinstance(kind, click.Choice) and (sane or rng.random() < 0.7):
        return [name, str(rng.choice([str(choice) for choice in kind.choices]))]
    number = isinstance(kind, click.types.IntParamType | click.types.FloatParamType)
    pool: Sequence[str]
    if sane:
        pool = ("1", "2", "5") if isinstance(kind, click.types.IntParamType) else ("0.1", "0.2", "0.5", "0.9")
    elif number and rng.random() < 0.7:
        pool = NUMBERS
    else:
        pool = (NUMBERS, WORDS, LISTS, SIZES)[rng.integers(4)]
    return [name, pool[rng.integers(len(pool))]]


def _path(command: str, param: click.Parameter, rng: np.random.Generator, sane: bool) -> str:
    is_output = bool(OUTPUT_NAMES & {*param.opts, str(param.name)}) or param.name == "output"
    if is_output:
        pool: Sequence[str] = SANE_OUTPUTS.get(command, ("out",)) if sane and rng.random() < 0.8 else OUTPUTS
    elif rng.random() < (0.95 if sane else 0.7):
        if str(param.name) in ("scene", "scenes", "photos", "source_path", "source"):
            pool = (*SCENES, "scene", "scene", "kitchen")
        elif command == "benchmark":
            pool = ("set", "set", "set/truck", "scene", ".")
        else:
            pool = (*MODELS, "model", "model", "model")
    else:
        pool = OTHERS
    return pool[rng.integers(len(pool))]


def point_into(root: Path, template: Path) -> None:
    """Make the stored model name the scene in this folder, not the one in the template."""
    for config in (root / "model" / "config.json", root / "files" / "config.json"):
        text = config.read_text(encoding="utf-8").replace(
            json.dumps(os.fspath(template))[1:-1], json.dumps(os.fspath(root))[1:-1]
        )
        config.write_text(text, encoding="utf-8")
