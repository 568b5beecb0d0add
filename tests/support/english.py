"""Checker of the style guide in CONTRIBUTING.md. It finds long sentences and private phrases in comments and documents.

python tests/support/english.py [PATH ...]      # print findings; all of the repository without a path
python tests/support/english.py --count [PATH ...]
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "clsplat",
    "cl",
    "cli",
    "blender",
    "benchmarks",
    "tests",
    "docs",
    "README.md",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
)
MAX_WORDS = 25  # words in a sentence
# Words that the first texts of this project used with a private meaning, and their replacements.
PRIVATE = {
    r"(?<!there )\bis no (?!longer|more|need)\w+": "is not a ...",
    r"(?<!there )\b(?:is|are) none\b|\bhas none\b|\bhave none\b": "there is no ..., does not have ...",
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\blook(s|ing|er|ers)?[- ]ons?\b": "watch, client",
    r"\bof which\b": "two sentences",
    r"\bas ever\b": "as before, as usual",
    r"\bsat out\b|\bsits out\b|\bsit out\b": "skipped",
    r"\bput down\b": "written, recorded",
    r"\bof itself\b|\bby themselves\b": "automatically, alone",
    r"\bknows? no\b|\bknow nothing of\b": "does not depend on",
    r"\btold\b|\btells\b": "says, passed to, shows",
    r"\bso many\b|\bso much\b(?! (as|that))": "that number of",
    r"\bill[- ]\w+|\bailments?\b": "fault",
    r"\bnought\b|\bthereby\b|\btherein\b|\bwhereof\b|\bhence\b|\bthus\b": "so",
    r"^Of [a-z]": "begin with the noun",
}
# Identifiers that describe a role in a sentence and do not name the thing.
ROLES = {"own", "most", "told", "given", "said", "wanted", "past", "least", "mine", "theirs", "asked"}


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of prose. Code, formulas, tables and headings are omitted."""
    text = re.sub(r"(?ms)^\s*```.*?^\s*```", "\n\n", text)
    text = re.sub(r"(?ms)<!--.*?-->", "", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    for paragraph in re.split(r"\n\s*\n|\n\s*(?=[-*|>#] |\d+\. |[\w, ]+ : )", text):
        if paragraph.lstrip().startswith(("|", "#", ">>>", "$")) or re.match(r"^ {4}\S", paragraph):
            continue
        flat = re.sub(r"^[-*>] |^\d+\. ", "", " ".join(paragraph.split()))
        yield from (part.strip() for part in re.split(r"(?<=[.!?;:])\)?\s+(?=[\"'(\w`])", flat) if part.strip())


def prose_of_python(source: str) -> Iterator[tuple[int, str]]:
    """Yield docstrings and comments with their line numbers."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text
    block, first, previous = [], 0, -2
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            text = token.string.lstrip("#! ")
            if re.match(r"type:|noqa|fmt:|pragma", text):
                continue
            if token.start[0] != previous + 1 or token.line[: token.start[1]].strip():
                if block:
                    yield first, "\n".join(block)
                block, first = [], token.start[0]
            block.append(text)
            previous = token.start[0]
    if block:
        yield first, "\n".join(block)


def prose_of_kernel(source: str) -> Iterator[tuple[int, str]]:
    """Yield comments of OpenCL C with their line numbers."""
    block, first = [], 0
    for number, line in enumerate(source.splitlines(), 1):
        match = re.search(r"//+ ?(.*)$", line)
        if match and not line[: match.start()].strip():
            block, first = [*block, match[1]], first or number
        else:
            if block:
                yield first, "\n".join(block)
            block, first = [], 0
            if match:
                yield number, match[1]
    if block:
        yield first, "\n".join(block)


def identifiers(path: Path, source: str) -> Iterator[tuple[int, str]]:
    """Yield names of variables, parameters and attributes with their line numbers."""
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Name):
                yield node.lineno, node.id
            elif isinstance(node, ast.arg):
                yield node.lineno, node.arg
            elif isinstance(node, ast.Attribute):
                yield node.lineno, node.attr
    elif path.suffix != ".md":
        for number, line in enumerate(source.splitlines(), 1):
            for name in re.findall(r"(?<!\w)[a-z]\w*", line.split("//")[0]):
                yield number, name


def findings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line numbers and complaints of one file."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        parts = prose_of_python(source)
    elif path.suffix in (".cl", ".clh"):
        parts = prose_of_kernel(source)
    else:
        parts = iter([(1, source)])
    if "tests" not in path.parts:  # hypothesis has `given`
        for line, name in identifiers(path, source):
            if name.strip("_") in ROLES:
                yield line, f"identifier {name!r}: name the thing"
    for line, text in parts:
        for sentence in sentences(text):
            n_words = len(re.findall(r"[^\W\d_]{2,}", sentence))
            if n_words > MAX_WORDS:
                yield line, f"{n_words} words: {sentence[:110]}"
            for pattern, better in PRIVATE.items():
                if found := re.search(pattern, sentence):
                    yield line, f"{found[0]!r} (better: {better}): {sentence[:90]}"


def files(paths: list[Path]) -> list[Path]:
    """Return the texts below these paths."""
    found = [file for path in paths for file in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return [file for file in found if file.suffix in (".py", ".cl", ".clh", ".md") and file.name != "english.py"]


def main() -> None:
    arguments = [argument for argument in sys.argv[1:] if argument != "--count"]
    paths = files([Path(argument) for argument in arguments] or [ROOT / folder for folder in FOLDERS])
    total = 0
    for path in paths:
        complaints = list(findings(path))
        total += len(complaints)
        if "--count" in sys.argv:
            if complaints:
                print(f"{len(complaints):4} {path}")
        else:
            for line, complaint in complaints:
                print(f"{path}:{line}: {complaint}")
    print(f"{total} findings in {len(paths)} files")
    sys.exit(1 if total else 0)


if __name__ == "__main__":
    main()
