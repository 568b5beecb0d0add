"""The version stands in one place: clsplat/_version.py. CITATION.cff, which no program writes, repeats it."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

from clsplat import _version

ROOT = Path(__file__).resolve().parents[2]
PLACES = {"clsplat/_version.py", "CITATION.cff"}
FOLDERS = ("clsplat", "cl", "cli", "blender", "docs", ".ci", ".")
# Such as `version = "1.0"`, `__version__ = "1.0"`, `version: 1.0` and `"version": "1.0"`.
DECLARED = re.compile(r"""^\W*(?:__)?version(?:__)?["']?\s*[:=]\s*["']?\d+\.\d""", re.M)


def texts() -> dict[str, str]:
    """Return the files that may declare a version, by name."""
    endings = {".py", ".toml", ".cff", ".cfg", ".in", ".js", ".html", ".md", ".cl", ".clh"}
    paths = [
        path
        for folder in FOLDERS
        for path in (ROOT / folder).glob("*" if folder == "." else "**/*")
        if path.is_file() and path.suffix in endings
    ]
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}


def test_the_version_has_one_place() -> None:
    assert {name for name, text in texts().items() if DECLARED.search(text)} == PLACES
    quoted = re.compile(rf"""["']{re.escape(_version.__version__)}["']""")
    programs = {name: text for name, text in texts().items() if name.endswith((".py", ".toml"))}
    assert {name for name, text in programs.items() if quoted.search(text)} == {"clsplat/_version.py"}


def test_setuptools_reads_it_without_an_import() -> None:
    """It reads an attribute from the text of a module only if the value is a literal."""
    about = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    assert "version" not in about["project"]
    assert about["project"]["dynamic"] == ["version"]
    assert about["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "clsplat._version.__version__"}
    docstring, assignment = ast.parse((ROOT / "clsplat" / "_version.py").read_text("utf-8")).body
    assert isinstance(docstring, ast.Expr)
    assert isinstance(assignment, ast.Assign)
    assert ast.literal_eval(assignment.value) == _version.__version__


def test_the_citation_has_the_version_and_what_the_format_requires() -> None:
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    values = dict(re.findall(r"^([\w-]+): (.+)$", text, re.M))
    assert values["version"] == _version.__version__
    assert (values["cff-version"], values["title"], values["license"]) == ("1.2.0", "clsplat", "MIT")
    assert {"message", "title"} <= set(values)
    assert re.search(r"^authors:\n  - name: \S", text, re.M)
    references = re.split(r"^  - type: ", text, flags=re.M)[1:]
    assert references
    for reference in references:
        assert re.search(r"^    title: \S", reference, re.M)
        assert re.search(r"^    authors:\n      - family-names: \S", reference, re.M)
