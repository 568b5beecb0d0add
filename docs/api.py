"""Renders the reference of clsplat's public names: python docs/api.py FOLDER [--overwrite].

It needs pdoc: pip install "clsplat[docs]".
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import MISSING
from pathlib import Path
from typing import Any

import clsplat
from clsplat.errors import OutputError
from clsplat.files.existing import refuse_existing
from clsplat.training.config import SECTIONS
from clsplat.training.options.density import STRATEGIES
from clsplat.training.options.option import Option, option_table

README = Path(__file__).resolve().parents[1] / "README.md"
# Headings of the first screen, with the packages whose names they have. Other packages have their name as heading.
TOPICS = {
    "Scenes and cameras": ("scenes", "cameras"),
    "Training": ("training", "compression"),
    "Splats and images": ("splats", "rendering"),
    "What the commands do": ("models", "benchmark"),
    "Errors": ("errors",),
}

_HEADING = re.compile(r"^([A-Z]\w+)\n-{3,}\n", re.M)
# Several may stand on a line: "width, height : of the image [px]. focal : ..."
_ITEM = re.compile(r"(?:^|(?<=[.;] ))([A-Za-z_*][\w.,* ]{0,60}?) : ")
_COMMENT = re.compile(r"^(\S.*\S) +# (.*)$", re.M)  # after code, where a narrow page would cut it


class _Written(str):
    """An annotation as the source has it, which Python prints without quotes."""

    __repr__ = str.__str__


def render(folder: Path, overwrite: bool = False) -> Path:
    """Write the pages; returns the first."""
    pages = {name: folder / name for name in ("clsplat.html", "index.html")}
    refuse_existing(list(pages.values()), overwrite)
    try:
        import pdoc
    except ImportError:
        sys.exit('error: pdoc is not installed: pip install "clsplat[docs]"')
    for name in clsplat.__all__:  # they load on first use, which pdoc does not ask for
        vars(clsplat)[name] = getattr(clsplat, name)
    clsplat.__all__ = [name for names in by_topic().values() for name in names]  # the order of the page
    pdoc.render.configure(
        docformat="markdown", show_source=False, search=False, footer_text=f"clsplat {clsplat.__version__}"
    )
    module = pdoc.doc.Module(clsplat)
    for member in module.flattened_own_members:
        _prepare(member)
    module.docstring = overview()
    folder.mkdir(parents=True, exist_ok=True)
    pages["clsplat.html"].write_text(pdoc.render.html_module(module, {"clsplat": module}), "utf-8")
    pages["index.html"].write_text(pdoc.render.html_index({"clsplat": module}), "utf-8")
    return pages["clsplat.html"]


def by_topic() -> dict[str, list[str]]:
    """The public names by the heading of their topic: functions first, then classes."""
    topics: dict[str, list[str]] = {title: [] for title in TOPICS}
    titles = {package: title for title, packages in TOPICS.items() for package in packages}
    for name in sorted(clsplat.__all__, key=lambda name: (name[0].isupper(), name)):
        package = getattr(clsplat, name).__module__.split(".")[1]
        topics.setdefault(titles.get(package, package), []).append(name)
    return topics


def overview() -> str:
    """The first screen: the example of the README, and each name with the first sentence of its docstring."""
    introduction = (clsplat.__doc__ or "").split("\n\n")[0].partition(": ")[2]
    example = re.search(r"^```python\n.*?^```$", README.read_text("utf-8"), re.M | re.S)
    code = _COMMENT.sub(r"# \2\n\1", example[0]) if example else ""
    parts = [f"Version {clsplat.__version__}. {introduction}", code]
    for title, names in by_topic().items():
        lines = [f"- `{name}`: {_summary(getattr(clsplat, name))}" for name in names]
        parts.append(f"## {title}\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def markdown_of(docstring: str) -> str:
    """A docstring with its NumPy sections as lists. They may have several items on a line."""
    head, *sections = _HEADING.split(docstring)
    parts = [head.strip()]
    for title, text in zip(sections[::2], sections[1::2], strict=True):
        entries = [" ".join(entry.split()) for entry in re.split(r"\n(?=\S)", text.strip())]
        items = [_ITEM.sub(r"\n- **\1**: ", entry).strip() for entry in entries]
        parts.append(f"*{title}*\n\n" + "\n".join(item if item.startswith("- ") else f"- {item}" for item in items))
    return "\n\n".join(parts)


def _prepare(member: Any) -> None:
    """Give an object of pdoc its docstring as Markdown, and the annotations of the source.

    pdoc would evaluate them, and show dozens of words for `ArrayLike`. Attributes are hidden if the class describes
    them in its docstring.
    """
    member.docstring = markdown_of(member.docstring)
    if member.kind == "function":
        member.signature = _signature(member.obj, member.name == "__init__")
    elif member.kind == "class":
        if member.obj is clsplat.TrainConfig:
            member.docstring += "\n\n" + "\n\n".join(_options())
        for inner in member.own_members:
            _prepare(inner)
            if inner.kind == "variable" and not inner.docstring and inner.name in _described(member.docstring):
                inner.docstring = "@private"
    elif written := _annotation(member):
        member.annotation_str = f": {_linked(written)}"


def _signature(function: Callable[..., Any], is_constructor: bool) -> inspect.Signature:
    """The signature with annotations as in the source."""
    signature = inspect.signature(function)
    parameters = [
        parameter.replace(annotation=_linked(parameter.annotation)) for parameter in signature.parameters.values()
    ]
    returned = inspect.Signature.empty if is_constructor else _linked(signature.return_annotation)
    return signature.replace(parameters=parameters, return_annotation=returned)


def _annotation(variable: Any) -> str:
    """The annotation of an attribute or a property in the source; "" if there is none."""
    owner = getattr(clsplat, variable.qualname.split(".")[0])
    static = inspect.getattr_static(owner, variable.name, None)
    getter = getattr(static, "fget", None) or getattr(static, "func", None)
    found = (
        getter.__annotations__.get("return", "") if getter else inspect.get_annotations(owner).get(variable.name, "")
    )
    return found if isinstance(found, str) else ""


def _linked(annotation: Any) -> Any:
    """An annotation whose public names pdoc links."""
    if not isinstance(annotation, str):
        return annotation
    public = "|".join(name for name in clsplat.__all__ if name[0].isupper())
    return _Written(re.sub(rf"(?<![\w.])({public})\b", r"clsplat.\1", annotation))


def _described(docstring: str) -> set[str]:
    """The names that the lists of a docstring describe."""
    return {name.strip() for item in re.findall(r"^- \*\*(.*?)\*\*:", docstring, re.M) for name in item.split(",")}


def _options() -> Iterator[str]:
    """Yield the training options as lists."""
    for title, options in SECTIONS.items():
        lines = [f"- **{option.name}**: {option.help}{_default(option)}" for option in options]
        yield f"*{title}*\n\n" + "\n".join(lines)


def _default(option: Option) -> str:
    """A sentence on the default of an option; "" if its help says what happens without it."""
    if option.by_scene:
        return " Default: by the scene."
    if option.default is None:
        return ""
    if option.default is not MISSING:
        return f" Default: {_shown(option.default)}."
    tables = {name: option_table(group) for name, group in STRATEGIES.items()}
    return f" Default: {', '.join(f'{_shown(table[option.name].default)} with {n}' for n, table in tables.items())}."


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(thing: object) -> str:
    """The first sentence of a docstring."""
    paragraph = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.) (?=[A-Z])", paragraph)[0]


if __name__ == "__main__":
    folders = [word for word in sys.argv[1:] if word != "--overwrite"]
    if len(folders) != 1:
        sys.exit("usage: python docs/api.py FOLDER [--overwrite]")
    try:
        print(render(Path(folders[0]), "--overwrite" in sys.argv))
    except OutputError as error:
        sys.exit(f"error: {error}")
