"""Errors a user can mend. Every message is one line: what is wrong, where, and the mend."""

from __future__ import annotations


class ClsplatError(Exception):
    """Base of all errors that clsplat raises on purpose; the CLI prints it as one line, exit code 1."""


class InputError(ClsplatError):
    """A file, folder or value that clsplat was given cannot be used."""


class OutputError(ClsplatError):
    """A result cannot be written, or would overwrite something."""


class DeviceError(ClsplatError):
    """No usable OpenCL device, a kernel that does not build, or a device without enough memory."""


class TrainingError(ClsplatError):
    """Training cannot go on; what was learnt so far is saved."""


def reason_of(error: Exception, most: int = 200) -> str:
    """What another library says of an error, in a line of `most` characters at most."""
    return " ".join(str(error).split())[:most] or type(error).__name__
