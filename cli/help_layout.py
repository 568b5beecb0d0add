"""Layout of `--help`: it fits the terminal, and no line ends inside a word, a short default or a quoted command."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

import click

# Parts that stay on one line: a default, a quoted command, or a word. The first two are split if they are long.
_UNIT = re.compile(r"\[default: [^\]]*\]|`[^`]*`\S*|\S+")
_WORD = re.compile(r"\[default: \S+|\S+")
_LONGEST_UNIT = 0.7  # of a line's width
_DEEPER = 4  # indentation of what continues or explains a line


class TerminalFormatter(click.HelpFormatter):
    """A writer of help texts, whose lines are at most as wide as the terminal."""

    def write_text(self, text: str) -> None:
        """Write paragraphs."""
        paragraphs = [wrapped(paragraph, self._room) for paragraph in re.split(r"\n\s*\n", text)]
        self._write_lines([line for lines in paragraphs for line in (*lines, "")][:-1])

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        """Write names and what they mean in two columns. The first one is so wide that all takes the fewest lines."""
        rows, half = list(rows), self._room // 2
        columns = {len(name) for name, _ in rows if len(name) <= half} or {half}
        tables = [self._table(rows, column, col_spacing) for column in sorted(columns, reverse=True)]
        self._write_lines(min(tables, key=len))

    @property
    def _room(self) -> int:
        """Width of a line after the indentation."""
        return self.width - self.current_indent

    def _table(self, rows: Sequence[tuple[str, str]], column: int, spacing: int) -> list[str]:
        lines = []
        for name, meaning in rows:
            texts = wrapped(meaning, self._room - column - spacing) or [""]
            if len(name) > column:
                lines += self._long_name(name)
            else:
                lines.append(name.ljust(column + spacing) + texts.pop(0))
            lines += [" " * (column + spacing) + text for text in texts]
        return lines

    def _long_name(self, name: str) -> list[str]:
        """Return the lines of a name. A list of choices goes on below its first choice."""
        if len(name) <= self._room:
            return [name]
        below = name.find("[") + 1
        first, *others = wrapped(name, self._room - below)
        return [first, *(" " * below + other for other in others)]

    def _write_lines(self, lines: Sequence[str]) -> None:
        margin = " " * self.current_indent
        self.write("".join(f"{margin}{line}".rstrip() + "\n" for line in lines))


class TerminalContext(click.Context):
    """A context whose help is laid out for the terminal."""

    formatter_class = TerminalFormatter


def write_examples(formatter: click.HelpFormatter, examples: Sequence[tuple[str, str]]) -> None:
    """Write the section of examples: command lines, each with what it does below."""
    with formatter.section("Examples"):
        margin = " " * formatter.current_indent
        deeper = margin + " " * _DEEPER
        for command, meaning in examples:
            formatter.write(margin + f" \\\n{deeper}{' ' * _DEEPER}".join(_command_lines(command, formatter)) + "\n")
            lines = wrapped(meaning, formatter.width - len(deeper))
            formatter.write("".join(f"{deeper}{line}\n" for line in lines))


def write_see_also(formatter: click.HelpFormatter, names: Sequence[str]) -> None:
    """Write the last line: the commands that come before or after this one."""
    if names:
        formatter.write_paragraph()
        line = "See also: " + ", ".join(f"clsplat {name}" for name in names)
        formatter.write("\n".join(wrapped(line, formatter.width)) + "\n")


def wrapped(text: str, width: int) -> list[str]:
    """Return the lines of a paragraph. They end at blanks. A word that is longer than a line ends at a comma or bar."""
    lines: list[str] = []
    for gap, piece in _pieces(text, width):
        if lines and len(lines[-1]) + len(gap) + len(piece) <= width:
            lines[-1] += gap + piece
        else:
            lines.append(piece)
    return lines


def _command_lines(command: str, formatter: click.HelpFormatter) -> list[str]:
    """Return the parts of a command line, between which a backslash continues it. An option keeps its value."""
    room = formatter.width - formatter.current_indent
    if len(command) <= room:
        return [command]
    glued = re.sub(r"( -\S+) (?!-)", r"\1\0", command)
    return [line.replace("\0", " ") for line in wrapped(glued, room - 2 * _DEEPER - len(" \\"))]


def _pieces(text: str, width: int) -> Iterator[tuple[str, str]]:
    """Yield what is not to be divided, with the blanks before it."""
    end = 0
    for match in _UNIT.finditer(text):
        gap, end = "  " if "  " in text[end : match.start()] else " ", match.end()
        whole = " ".join(match[0].split())
        for unit in [whole] if len(whole) <= width * _LONGEST_UNIT else _WORD.findall(whole):
            for piece in [unit] if len(unit) <= width else re.findall(r"[^,|]*[,|]|[^,|]+", unit):
                yield gap, piece
                gap = ""
            gap = " "
