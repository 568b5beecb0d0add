"""The `clsplat` command: loads one subcommand, and prints each error as one line."""

from __future__ import annotations

import importlib
import io
import re
import sys
import traceback
import warnings
from typing import Any, TextIO

import click

from clsplat import __version__
from clsplat.errors import FEWER_SPLATS, OTHER_DEVICE, SMALLER_IMAGES, ClsplatError, Remedy
from clsplat.files import stop_signals
from clsplat.files.standard_streams import drop_unread

from .command import nearest_command
from .help_layout import write_examples

# Each command: (module:attribute, line of --help). The table lets --help work without importing the modules.
COMMANDS = {
    "devices": ("clsplat_cli.devices:devices", "List the OpenCL devices and try each."),
    "demo": ("clsplat_cli.demo:demo", "Make a small scene, train, render and measure: a first trial."),
    "reconstruct": (
        "clsplat_cli.reconstruct:reconstruct_scene",
        "Make a scene from photographs or a video.",
    ),
    "train": ("clsplat_cli.train:train", "Learn a splat model of a scene."),
    "view": ("clsplat_cli.view:view", "Walk through a model in the browser."),
    "render": ("clsplat_cli.render:render", "Render a model or any splat PLY."),
    "eval": ("clsplat_cli.evaluate:evaluate_models", "Measure models on views that were held out of training."),
    "info": ("clsplat_cli.info:show_info", "Show what a model or a scene contains."),
    "clean": ("clsplat_cli.clean:clean_model", "Remove floaters and what no training view sees."),
    "lod": ("clsplat_cli.lod:lod", "Merge splats in levels of detail, and measure them."),
    "prune": ("clsplat_cli.prune:prune_model", "Remove the splats that a model's images do not need."),
    "compare": ("clsplat_cli.compare:compare_systems", "Train published systems side by side and print a table."),
    "frontier": ("clsplat_cli.frontier:draw_frontier", "Train systems at several caps and chart quality against cost."),
    "benchmark": (
        "clsplat_cli.benchmark:benchmark",
        "Repeat a published benchmark by its protocol.",
    ),
    "partition": ("clsplat_cli.partition:partition", "Divide a large scene into blocks, and show them."),
    "worker": ("clsplat_cli.worker:start_workers", "Do training runs of other commands on this machine's devices."),
    "bench": ("clsplat_cli.bench:bench", "Time the stages of training and rendering on this device."),
    "blender-addon": ("clsplat_cli.blender_addon:build_addon", "Build the Blender add-on as a zip."),
    "convert": (
        "clsplat_cli.convert:convert_model",
        "Convert a model to another shape or file format.",
    ),
    "cameras": ("clsplat_cli.cameras:write_cameras_of", "Write the cameras of a scene or a model for other programs."),
}
EXAMPLES = (
    ("clsplat demo out", "A first trial, with a scene that it makes itself."),
    ("clsplat train PHOTOS -m MODEL", "A model of your photos, or of a video."),
    ("clsplat view MODEL", "Look at it in the browser."),
)
# The codes of error and stop_signals.exit_code, and click's for a wrong command line.
EXIT_CODES = (
    ("0", "Success."),
    ("1", "An error, in one line on standard error."),
    ("2", "A wrong command line."),
    ("130", "Stopped by Ctrl-C. Another signal: 128 plus its number."),
    ("141", "The reader of the output, such as head, has ended."),
)
_READER_GONE = 128 + 13  # the code of a Unix tool that SIGPIPE ends
_LONGEST_WORD = 400  # characters of a word that a message shows in full; a path may be that long


class _ReaderGone(Exception):
    """The reader of a standard stream has ended, as `head` does after its last line."""


class Commands(click.Group):
    """A group of subcommands that are imported when they are used, with one-line errors."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what follows the list of commands."""
        write_examples(formatter, EXAMPLES)
        with formatter.section("Exit codes"):
            formatter.write_dl(EXIT_CODES)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # click 8.2 and later would make an error of the help, and `main` would print it as one line.
        if not args and not ctx.resilient_parsing:
            click.echo(ctx.get_help(), err=True)
            ctx.exit(2)
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError:
            if args[0].startswith("-"):
                raise
            raise click.UsageError(f"no command {args[0]!r}{nearest_command(args[0], list(COMMANDS))}", ctx) from None

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        try:
            return super().make_context(*args, **extra)
        except KeyboardInterrupt:  # click would write an empty line before the message
            raise click.Abort from None
        except BrokenPipeError:  # click would exit with code 1
            raise _ReaderGone from None

    def invoke(self, ctx: click.Context) -> Any:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt:
                _fail(ctx, stop_signals.reason(), stop_signals.exit_code())
            except ClsplatError as error:
                _fail(ctx, error.for_command(self._options(ctx)))
            except Exception as error:
                if isinstance(error, BrokenPipeError) and _is_of_echo(error):
                    raise _ReaderGone from None
                known = _known_failure(error)
                if known is None:
                    raise
                _fail(ctx, known.for_command(self._options(ctx)))

    def _options(self, ctx: click.Context) -> set[str]:
        """Return the options of the command that runs."""
        command = self.get_command(ctx, ctx.invoked_subcommand or "")
        return {option for param in command.params for option in param.opts} if command else set()

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run as click does, but print a wrong command line as one line too (exit code 2)."""
        extra["standalone_mode"] = False
        for stream in (sys.stdout, sys.stderr):  # names of files need not be text in the terminal's encoding
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        stop_signals.forget()
        try:
            code = super().main(*args, **extra)
        except click.UsageError as error:
            see = f" (see: {error.ctx.command_path} --help)" if error.ctx else ""
            click.echo(f"error: {_one_line(error.format_message())}{see}", err=True)
            code = error.exit_code
        except click.ClickException as error:
            click.echo(f"error: {_one_line(error.format_message())}", err=True)
            code = error.exit_code
        except click.Abort:
            click.echo(f"error: {stop_signals.reason()}", err=True)
            code = stop_signals.exit_code()
        except _ReaderGone:
            drop_unread()
            code = _READER_GONE
        except OSError as error:  # of the text of --help or --version
            click.echo(f"error: {_of_system(error)}", err=True)
            code = 1
        sys.exit(code if isinstance(code, int) else 0)


@click.group(
    cls=Commands,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "token_normalize_func": lambda token: token.replace("_", "-"),  # 3DGS writes --sh_degree
        "max_content_width": 110,
    },
)
@click.version_option(__version__, prog_name="clsplat", message="%(prog)s %(version)s")
def main() -> None:
    """Gaussian and skew-normal splatting on any OpenCL device.

    `clsplat COMMAND --help` describes a command.
    """


def _fail(ctx: click.Context, message: str, code: int = 1) -> None:
    click.echo(f"error: {_one_line(message)}", err=True)
    ctx.exit(code)


def _known_failure(error: Exception) -> ClsplatError | None:
    """Return the error of clsplat for one from outside. None for a bug in clsplat."""
    if isinstance(error, MemoryError):
        return ClsplatError("out of memory", FEWER_SPLATS, SMALLER_IMAGES, Remedy("close other programs"))
    if isinstance(error, OSError):
        return _of_system(error)
    cl = sys.modules.get("pyopencl")  # if it is not loaded, the error is not from OpenCL
    if cl is None or not isinstance(error, cl.Error):
        return None
    from clsplat.device.opencl import first_line, is_out_of_memory

    if is_out_of_memory(error):
        return ClsplatError("device out of memory", FEWER_SPLATS, SMALLER_IMAGES, OTHER_DEVICE)
    return ClsplatError(f"the OpenCL device failed: {first_line(error)}", Remedy("try `clsplat devices`"), OTHER_DEVICE)


def _of_system(error: OSError) -> ClsplatError:
    """Return the error of clsplat for one of the system."""
    if error.filename:
        return ClsplatError(f"{error.filename}: {error.strerror}")
    if _is_of_echo(error):
        return ClsplatError(f"standard output: cannot be written ({error.strerror}): send it elsewhere")
    return ClsplatError(str(error))


def _is_of_echo(error: OSError) -> bool:
    """Return whether an error comes from writing a text to a standard stream."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return bool(frames) and frames[-1].f_code is click.echo.__code__


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if display := sys.modules.get("clsplat.training.live_line"):  # if it is not loaded, no live line is shown
        display.LiveLine.give_way()
    click.echo(f"warning: {_one_line(str(message))}", err=True)


def _one_line(text: str) -> str:
    """Return a text in one line. Control characters, which could move the cursor or hide words, are escaped.

    Words of hundreds of characters are shortened.
    """
    text = " ".join(text.split("\n"))
    text = re.sub(rf"\S{{{_LONGEST_WORD},}}", lambda word: f"{word[0][:100]}...{word[0][-50:]}", text)
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)
