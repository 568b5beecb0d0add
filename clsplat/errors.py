"""Errors that a user can fix. Each message is one line that says what is wrong, where, and how to fix it."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager

_NAMED = re.compile(r"([a-z]+(?:_[a-z]+)*) [^/]+?: ")  # at the start of a message


class Remedy:
    """One way to fix an error, for example "use fewer splats".

    Parameters
    ----------
    text : what to do. It names no option, because functions do not have options.
    flags : options of commands that do it, such as "--cap-max" or "-r 2, 4, 8". Each command has some or none of them.
    """

    def __init__(self, text: str, *flags: str) -> None:
        self.text, self.flags = text, flags

    def for_command(self, options: Collection[str]) -> str | None:
        """Return the text with the flags that a command has; None if the remedy needs a flag that it lacks."""
        known = [flag for flag in self.flags if flag.split()[0] in options]
        if not self.flags:
            return self.text
        return f"{self.text} ({' or '.join(known)})" if known else None


class ClsplatError(Exception):
    """Base of all errors that clsplat raises on purpose. The command line prints one line and exits with code 1.

    Parameters
    ----------
    message : what is wrong, and where. An error without `remedies` also says here how to fix it.
    remedies : ways to fix it. Each command shows those that it has options for.
    """

    def __init__(self, message: str = "", *remedies: Remedy) -> None:
        super().__init__(message, *remedies)
        self.message, self.remedies = message, remedies

    def __str__(self) -> str:
        return _sentence(self.message, [remedy.text for remedy in self.remedies])

    def for_command(self, options: Collection[str]) -> str:
        """Return the message with the remedies of a command, which has these options.

        A message that begins with the name and value of an option, such as "cap_max 0: ...", begins with its flag.
        """
        texts = (remedy.for_command(options) for remedy in self.remedies)
        named = _NAMED.match(self.message)
        flag = f"--{named[1].replace('_', '-')}" if named else ""
        message = flag + self.message[len(named[1]) :] if named and flag in options else self.message
        return _sentence(message, [text for text in texts if text is not None])


class InputError(ClsplatError):
    """An input file, folder or value cannot be used."""


class OutputError(ClsplatError):
    """A result cannot be written, or would overwrite something."""


class DeviceError(ClsplatError):
    """An OpenCL device is missing or has too little memory, or a kernel does not build."""


class TrainingError(ClsplatError):
    """Training cannot go on. The model trained so far is saved."""


class ClusterError(ClsplatError):
    """The scheduler of a cluster or its workers cannot be used."""


def check_choice(name: str, value: str, choices: Collection[str]) -> None:
    """Raise InputError unless an option has one of its values. name : of the option, or of the parameter."""
    if value not in tuple(choices):  # a value of any type, also one without a hash
        raise InputError(f"{name} {value!r}: choose one of {', '.join(choices)}")


FEWER_SPLATS = Remedy("use fewer splats", "--cap-max", "--splats")
SMALLER_IMAGES = Remedy("use smaller images", "-r 2, 4, 8", "--size WxH", "--width N", "--max-size PX")
OTHER_DEVICE = Remedy("choose another device", "--device")


def _sentence(message: str, remedies: list[str]) -> str:
    """Return "message: remedy, remedy or remedy"."""
    if not remedies:
        return message
    *others, last = remedies
    return f"{message}: {', '.join(others)} or {last}" if others else f"{message}: {last}"


def reason_of(error: Exception, max_length: int = 200) -> str:
    """Return another library's message as one line of at most `max_length` characters."""
    return " ".join(str(error).split())[:max_length] or type(error).__name__


@contextmanager
def named_place(place: str) -> Iterator[None]:
    """Begin the messages of InputErrors in the block with a place: a file, and the entry in it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
