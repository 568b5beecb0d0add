"""What a device's compiler may not survive, found in the text of kernels.

Each function takes OpenCL C text without comments and returns the places it finds, as short excerpts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)
_STRUCT = re.compile(r"\}\s*(\w+)\s*;")  # the end of a typedef
_FUNCTION = re.compile(r"\b(\w+)\s*\(([^(){};]*)\)\s*\{")
_NUMBER = re.compile(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][-+]?\d+)?\w*")
_ASSIGNMENT = r"(?:[-+*/|&^%]|<<|>>)?=(?!=)"
_CONTROL = ("if", "for", "while", "switch")


def without_comments(text: str) -> str:
    return _COMMENT.sub(" ", text)


def double_literals(text: str) -> list[str]:
    """Return numbers with a fraction or an exponent that are neither R(...) nor have the suffix f."""
    return [
        match.group()
        for match in _NUMBER.finditer(text)
        if not match.group().endswith(("f", "F")) and not re.search(r"\bR\(\s*-?$", text[: match.start()])
    ]


def struct_names(text: str) -> set[str]:
    """Return the names of all types that are defined as structs."""
    return set(_STRUCT.findall(text))


def writes_to_copies(text: str, structs: set[str]) -> list[str]:
    """Return writes to parameters that are structs by value, and places that take the address of one."""
    found = []
    for name, parameters, body in _functions(text):
        words = [parameter.split() for parameter in parameters.split(",") if "*" not in parameter]
        for copy in (word[-1] for word in words if len(word) > 1 and word[-2] in structs):
            place = rf"(?<![\w.>]){copy}\b(?:\.\w+|\[[^\]]*\])*\s*"
            writes = rf"{place}(?:{_ASSIGNMENT}|\+\+|--)|(?:\+\+|--)\s*{copy}\b|(?<!&)&\s*{copy}\b"
            found += [f"{name}: {match.group()}" for match in re.finditer(writes, body)]
    return found


def _functions(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, parameters and body of every function."""
    for match in _FUNCTION.finditer(text):
        if match.group(1) in _CONTROL:
            continue
        end, depth = match.end(), 1
        while depth:
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
        yield match.group(1), match.group(2), text[match.end() : end]
