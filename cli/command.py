"""Commands whose `--help` is one screen with examples. Options that few need are under `--help-all`, in sections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import click

from .help_layout import TerminalContext, write_examples, write_see_also

_ALL = "clsplat.help_all"  # key in `Context.meta`
_SHORT_TEXT = 2  # paragraphs of the description that the short help shows
OTHER = "Other options"


class DocumentedCommand(click.Command):
    """A command whose help fits the terminal and ends with examples.

    Parameters
    ----------
    examples : command lines, each with a sentence on what it does.
    see_also : names of commands that come before or after this one.
    environment : variables that the command reads, each with what it does.
    """

    context_class = TerminalContext

    def __init__(
        self,
        *args: Any,
        examples: Sequence[tuple[str, str]],
        see_also: Sequence[str] = (),
        environment: Sequence[tuple[str, str]] = (),
        **extra: Any,
    ) -> None:
        super().__init__(*args, **extra)
        self.examples, self.see_also, self.environment = examples, see_also, environment

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what follows the options."""
        if self.environment:
            with formatter.section("Environment"):
                formatter.write_dl(self.environment)
        write_examples(formatter, self.examples)
        write_see_also(formatter, self.see_also)


class SectionOption(click.Option):
    """An option that names its section of the help, for options that several commands share."""

    def __init__(self, *args: Any, section: str, **extra: Any) -> None:
        super().__init__(*args, **extra)
        self.section = section


class SectionedCommand(DocumentedCommand):
    """A command with a short `--help` and a long `--help-all`.

    The short help has the first two paragraphs of the description and the first section of options.

    Parameters
    ----------
    sections : names of parameters by heading. Options in none of them are in the section that they name
        themselves, or else under "Other options". The first section also has the two options for help.
    """

    def __init__(self, *args: Any, sections: Mapping[str, Sequence[str]], **extra: Any) -> None:
        super().__init__(*args, **extra)
        self.sections = sections
        self.params.append(
            click.Option(
                ["--help-all"],
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_show_all,
                help="Show all options, in groups, and exit.",
            )
        )

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the description: all of it, or its beginning in the short help."""
        text, whole = self.help or "", _ALL in ctx.meta
        self.help = text if whole else "\n\n".join(text.split("\n\n")[:_SHORT_TEXT])
        try:
            super().format_help_text(ctx, formatter)
        finally:
            self.help = text

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write all sections of options, or the first one in the short help."""
        records: dict[str, list[tuple[str, str]]] = {}
        for heading, options in self.sectioned(ctx).items():
            records[heading] = [record for option in options if (record := option.get_help_record(ctx))]
        for heading in list(records)[: None if _ALL in ctx.meta else 1]:
            with formatter.section(heading):
                formatter.write_dl(records[heading])

    def sectioned(self, ctx: click.Context) -> dict[str, list[click.Option]]:
        """Return the options by heading, in the order of the help."""
        options = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        by_name = {option.name: option for option in options}
        found = {heading: [by_name.pop(name) for name in names] for heading, names in self.sections.items()}
        common = next(iter(found))
        for option in by_name.values():
            for_help = option.is_eager and not option.expose_value
            heading = common if for_help else option.section if isinstance(option, SectionOption) else OTHER
            found.setdefault(heading, []).append(option)
        return found


def nearest_command(name: str, known: Sequence[str]) -> str:
    """Return the words "; did you mean ...?" for a command that does not exist, or "" if none is near."""
    near = get_close_matches(name, known, n=2)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _show_all(ctx: click.Context, param: click.Parameter, chosen: bool) -> None:
    if chosen and not ctx.resilient_parsing:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()
