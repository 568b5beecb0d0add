"""XML files of other programs: reading without document types, and checked access to their numbers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .json_file import MAX_NUMBER
from .whole_file import read_whole


class _PlainBuilder(ET.TreeBuilder):
    """A builder of trees that refuses document types, because their entities can grow without limit."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it has a document type")


def read_xml(path: Path, expected: str) -> ET.Element:
    """Return the root of an XML file.

    Parameters
    ----------
    expected : the kind of file to choose instead, for the error message.

    Raises
    ------
    InputError : the file cannot be read, is not XML, or has a document type.
    """
    try:
        parser = ET.XMLParser(target=_PlainBuilder())
        parser.feed(read_whole(path))
        root: ET.Element = parser.close()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); check its name and permissions"
        ) from None
    except (ET.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path}: is not plain XML ({str(error).splitlines()[0][:100]}); choose {expected}") from None
    return root


def get_numbers(parent: ET.Element, name: str, count: int) -> NDArray[np.float64] | None:
    """Return the numbers in the text of a child, (count,), or None without the child.

    Raises
    ------
    InputError : the text has another number of words, or a word is not a number below 1e30.
    """
    child = parent.find(name)
    if child is None:
        return None
    words = (child.text or "").split()
    values = np.array([to_number(word) for word in words])
    if len(words) != count or not (np.abs(values) < MAX_NUMBER).all():
        form = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"<{name}> is {ascii(' '.join(words))[:60]}; expected {form}")
    return values


def to_number(text: str) -> float:
    """Return a text as a number; NaN for any other text."""
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        return math.nan
