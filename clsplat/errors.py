"""Errors that a user can fix. Each message is one line that says what is wrong, where, and how to fix it."""

from __future__ import annotations


class ClsplatError(Exception):
    """Base of all errors that clsplat raises on purpose. The command line prints one line and exits with code 1."""


class InputError(ClsplatError):
    """An input file, folder or value cannot be used."""


class OutputError(ClsplatError):
    """A result cannot be written, or would overwrite something."""


class DeviceError(ClsplatError):
    """An OpenCL device is missing or has too little memory, or a kernel does not build."""


class TrainingError(ClsplatError):
    """Training cannot go on. The model trained so far is saved."""


def reason_of(error: Exception, max_length: int = 200) -> str:
    """Return another library's message as one line of at most `max_length` characters."""
    return " ".join(str(error).split())[:max_length] or type(error).__name__
