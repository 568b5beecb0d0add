"""Command lines with values that a user should not give, made from click's own lists of parameters.

A new option is in `cases` without a line here. Each command starts from a line that works (`BASES`), small enough to
run to its end. Work that a value makes long is interrupted as by Ctrl-C (`bounded`), so that each line ends soon.
"""

from __future__ import annotations

import itertools
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import click
import pytest
from cli_runner import flags_of, foreign_flags, run
from clsplat_cli.main import COMMANDS, main

SECONDS = 20  # of the processor: a line that takes longer is a fault
WAIT = 180  # seconds of the clock, after which a line hangs. Other programs make a line take longer.
MEMORY = 256 << 20  # bytes that the device pretends to have free
WIDE, TOO_WIDE = 400, 1 << 30  # photos of a width between these are read as if WIDE: larger ones only take longer
DRAWN = 100  # largest width of photos that the demo draws: larger ones only take longer
DRAWN_VIEWS = 20  # largest number of photos that the demo draws
INTERRUPTED = 130

NUMBERS = (
    *("nan", "inf", "-inf", "1e300", "-1e300", "1e-320", "-1", "0", "0.5", "1", "3", "16", "2147483648"),
    *("9223372036854775808", "1" + "0" * 30, "9" * 5000, "１２", "٣", "1_000", "0x10", "1e3", "+2", " 5 ", "-0"),
)
TEXTS = ("", " ", ",", ",,", "nan,nan,nan", "1,2", "0,0,inf", "a=b", "x:y=z", "-", "ü/ñ", "\x1b[31m", "a\nb", "a\0b")
ODD_TEXTS = ("\udcff", "*" * 300, "1x1", "99999x99999", "0x0", "auto", "none", "'", "{}", "[1]", "\u202e", "-q", "a\rb")
# Places below the folder of a case; `prepare` makes them.
PATHS = ("{place}/missing/x.ply", "{place}/folder", "{place}/empty.ply", "{place}/text.json", "{place}/empty.ply/x")
ODD_PATHS = ("/dev/null", "{place}/" + "n" * 300, "{place}/ü ñ.mp4", "..", "{model}", "{scene}", "{place}/link")
HOSTILE = (*NUMBERS, *TEXTS, *ODD_TEXTS, *PATHS, *ODD_PATHS)

# Lines that work; {out} does not exist yet.
BASES: dict[str, tuple[str, ...]] = {
    "devices": (),
    "demo": ("{out}", "--iterations", "1", "--cap-max", "9", "--width", "32", "--views", "4", "-q"),
    "reconstruct": ("{scene}/images", "-o", "{out}"),
    "train": ("{scene}", "-m", "{out}", "--iterations", "2", "--cap-max", "9", "--sh-degree", "0"),
    "partition": (
        "{scene}",
        "-m",
        "{out}",
        "--blocks",
        "2x1",
        "--iterations",
        "2",
        "--cap-max",
        "9",
        "--sh-degree",
        "0",
    ),
    "worker": ("127.0.0.1:9", "--device", "cpu"),
    "view": ("{model}", "--port", "0"),
    "render": ("{model}", "-o", "{out}", "--path", "orbit", "--frames", "2", "--size", "16x16"),
    "eval": ("{model}", "--save-renders", "{out}"),
    "info": ("{scene}",),
    "clean": ("{model}", "-o", "{out}.ply"),
    "lod": ("{model}", "-o", "{out}", "--levels", "2"),
    "prune": ("{model}", "-o", "{out}.ply"),
    "compare": ("{scene}", "-o", "{out}", "--systems", "gaussian", "--cap-max", "9", "--iterations", "2"),
    "frontier": (
        *("{scene}", "-o", "{out}", "--systems", "gaussian", "--cap-max", "9", "--iterations", "2", "--curve", "0"),
        *("--sh-degree", "0"),
    ),
    "benchmark": (
        *("tanks", "{place}/set", "-o", "{out}", "--systems", "gaussian", "--cap-max", "9", "--iterations", "2"),
        *("--sh-degree", "0"),
    ),
    "bench": ("--splats", "9", "--width", "16", "--height", "16", "--iterations", "1"),
    "blender-addon": ("-o", "{out}.zip"),
    "convert": ("{model}", "{out}.ply"),
    "cameras": ("{model}", "{out}.json"),
}


class TooLong(BaseException):
    """A line took longer than SECONDS of the processor, or than WAIT."""


@dataclass(frozen=True)
class Places:
    """Folders of the cases: a scene, a model, and a place for outputs and odd files."""

    scene: Path
    model: Path
    place: Path

    def prepare(self) -> None:
        """Make the odd files."""
        for name in ("folder", "cwd"):
            (self.place / name).mkdir(parents=True, exist_ok=True)
        (self.place / "empty.ply").write_bytes(b"")
        (self.place / "text.json").write_text('{"a": [1, 2]}', encoding="utf-8")
        (self.place / "link").symlink_to(self.place / "nowhere")
        (self.place / "set").mkdir()
        (self.place / "set" / "truck").symlink_to(self.scene)

    def fill(self, args: tuple[str, ...], number: int) -> list[str]:
        """Return the arguments with the paths of case `number`."""
        known = {"scene": self.scene, "model": self.model, "place": self.place, "out": self.place / f"out{number}"}
        filled = []
        for arg in args:
            for name, path in known.items():
                arg = arg.replace("{" + name + "}", str(path))
            filled.append(arg)
        return filled


def params_of(command: str) -> list[click.Parameter]:
    """Return the parameters of a command, except those that print help."""
    found = main.get_command(click.Context(main), command)
    assert found is not None
    return [param for param in found.params if param.expose_value]


def with_value(command: str, param: click.Parameter, value: str, base: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return a line of the command, by default its base, with one parameter set to a value.

    A flag without a value is set, or unset if the value is "-" and the flag has an opposite.
    """
    base = base or BASES[command]
    if isinstance(param, click.Argument):
        place = [one for one in params_of(command) if isinstance(one, click.Argument)].index(param)
        dashes = ("--",) if value.startswith("-") and "--" not in base else ()
        known = place < len(base) and not base[place].startswith("-")
        rest = base[place + 1 :] if known else base[place:]
        return (*base[:place], *rest, *dashes, value) if dashes else (*base[:place], value, *rest)
    if getattr(param, "is_flag", False):
        flag = (param.secondary_opts or param.opts)[0] if value == "-" else param.opts[0]
        return _before_dashes(base, flag)
    for flag in param.opts:
        if flag in base:
            place = base.index(flag)
            return (*base[: place + 1], value, *base[place + 2 :])
    return _before_dashes(base, f"{max(param.opts, key=len)}={value}")


def _before_dashes(line: tuple[str, ...], option: str) -> tuple[str, ...]:
    place = line.index("--") if "--" in line else len(line)
    return (*line[:place], option, *line[place:])


def cases(command: str, offset: int = 0, step: int = 1) -> Iterator[tuple[str, ...]]:
    """Yield lines with one hostile value each: every `step`th of the values of each parameter."""
    for index, param in enumerate(params_of(command)):
        if getattr(param, "is_flag", False):
            yield from (with_value(command, param, value) for value in ("", "-"))
            continue
        choices = param.type.choices if isinstance(param.type, click.Choice) else ()
        values = (*HOSTILE, *map(str, choices))
        for value in itertools.islice(values, (offset + 7 * index) % step, None, step):
            yield with_value(command, param, value)


@contextmanager
def bounded(patch: pytest.MonkeyPatch, plan_only: bool = False) -> Iterator[None]:
    """End long work as Ctrl-C would, and refuse much memory.

    Parameters
    ----------
    plan_only : end a command where its work on the device would begin. It has then read its arguments and its inputs.
    """
    import clsplat_cli.frontier
    import clsplat_cli.progress  # noqa: F401

    from clsplat.profiling.roofline import Roofline
    from clsplat.scenes.demo import make
    from clsplat.scenes.photo_size import target_size
    from clsplat.training.progress import TrainingDisplay
    from clsplat.viewer.session import ViewingSession

    def interrupt(*args: Any, **values: Any) -> None:
        raise KeyboardInterrupt

    shown = sys.modules["clsplat_cli.progress"].ViewCount.__call__

    def third_view(display: Any, number: int, total: int) -> None:
        if number > 2 and total > 20:
            raise KeyboardInterrupt
        shown(display, number, total)

    def progress(display: TrainingDisplay, at: Any) -> None:
        if 50 <= at.iteration < at.iterations:
            raise KeyboardInterrupt

    def smaller(width: int, height: int, resolution: int) -> tuple[int, int]:
        return target_size(width, height, WIDE if WIDE < resolution < TOO_WIDE else resolution)

    def narrow(write: Any) -> Any:
        def written(folder: Path, width: int, height: int, n_views: int, *n_points: int) -> None:
            size = (DRAWN, DRAWN * 3 // 4) if width > DRAWN else (width, height)
            drawn = min(n_views, DRAWN_VIEWS)
            write(folder, *size, drawn, *(n * drawn // n_views for n in n_points))

        return written

    def run_twice(run: Any, record: Any) -> None:
        if run.repeat > 2:
            raise KeyboardInterrupt

    patch.setattr("clsplat_cli.frontier.report_run", run_twice)
    patch.setattr("clsplat.profiling.roofline.measure_roofline", lambda device: Roofline(1e10, 1e11))
    patch.setattr("clsplat_cli.progress.ViewCount.__call__", third_view)
    patch.setattr(TrainingDisplay, "__call__", progress)
    patch.setattr("clsplat.scenes.read_view.target_size", smaller)
    for name in ("write_capture", "write_street"):  # the demo draws its photos on one core
        patch.setattr(make, name, narrow(getattr(make, name)))
    patch.setattr(ViewingSession, "run", interrupt)
    patch.setattr("clsplat.scenes.reconstruct.reconstruct.run_sfm", interrupt)
    for module in ("clsplat.device.device", "clsplat.scenes.photo_size"):
        patch.setattr(f"{module}.available_bytes", lambda: MEMORY)
    if plan_only:
        for place in ("training.run.Trainer", "models.prune._pruned"):
            patch.setattr(f"clsplat.{place}", interrupt)
        for place in ("comparison.compare.warm_up", "comparison.measure.warm_up"):
            patch.setattr(f"clsplat.{place}", interrupt)
        for place in ("rendering.renderer.Renderer.render", "profiling.bench.bench_trainer"):
            patch.setattr(f"clsplat.{place}", interrupt)
        patch.setattr("clsplat.scenes.demo.make.make_demo_scene", interrupt)
        patch.setattr("clsplat.compression.search.train_budget", interrupt)
    yield


def fault_of(args: list[str]) -> str | None:
    """Run a line and return what is wrong with how it ends; None if it ends well."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.signal(signal.SIGPROF, _too_long)
    signal.alarm(WAIT)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        result = run(*args)
    except TooLong as reason:
        return str(reason)
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
    if not isinstance(result.exception, (SystemExit, type(None))):
        return f"traceback: {result.exception!r}"
    if result.exit_code not in (0, 1, 2, INTERRUPTED):
        return f"exit code {result.exit_code}"
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    if result.exit_code in (1, 2) and errors != lines[-1:]:
        return f"no single line of error at the end: {result.stderr[-300:]!r}"
    if "Traceback" in result.stderr:
        return "prints a traceback"
    for line in errors:
        if not line.isprintable():
            return f"control characters: {line!r}"
        said = line
        for arg in args:  # a message may quote what the user wrote
            value = arg.partition("=")[2] if arg.startswith("--") else arg
            if value and value not in flags_of(args[0]):
                said = said.replace(value, "...")
        if foreign := foreign_flags(said, args[0]):
            return f"names {foreign}: {line}"
        if len(line) > 1500:
            return f"an error of {len(line)} characters: {line[:200]}"
    return None


def _too_long(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGPROF:
        raise TooLong(f"took longer than {SECONDS} s of the processor")
    raise TooLong(f"took longer than {WAIT} s")


assert set(BASES) == set(COMMANDS)
