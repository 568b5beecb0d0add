"""docs/api.py renders each public name with its docstring, and nothing on the page is garbled."""

from __future__ import annotations

import html
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import clsplat
from clsplat.training.config import OPTIONS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page that docs/api.py makes."""
    pytest.importorskip("pdoc", reason="pdoc is not installed (pip install clsplat[docs])")
    folder = tmp_path_factory.mktemp("reference")
    command = [sys.executable, "-W", "error", str(ROOT / "docs" / "api.py"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert {path.name for path in folder.iterdir()} == {"index.html", "clsplat.html"}
    return (folder / "clsplat.html").read_text("utf-8")


def plain(page: str) -> str:
    """Return the text of a page in one line, without quotes and asterisks, which Markdown may change."""
    return re.sub(r"[`*_\"']|\s", "", html.unescape(re.sub(r"<[^>]*>", "", page)).replace("‘", "").replace("’", ""))


def text_of_code(page: str) -> str:
    """Return a page in one line, without the tags inside its code."""
    return re.sub(r"</?(?:span|code|a)\b[^>]*>", "", page).replace("\n", " ")


@pytest.mark.parametrize("name", clsplat.__all__)
def test_docstrings_are_rendered(name: str, reference: str) -> None:
    """Each public name has a section with the first paragraph of its docstring, and an entry on the first screen."""
    section = reference[reference.index(f'<section id="{name}">') :].partition("</section>")[0]
    paragraph = (inspect.getdoc(getattr(clsplat, name)) or "").split("\n\n")[0]
    assert plain(paragraph) in plain(section)
    first, _, _ = reference.partition("<section id=")
    assert f'<code><a href="#{name}">{name}</a></code>:' in first


def test_the_reference_can_be_read(reference: str) -> None:
    assert "<li><strong>target_psnr</strong>: replaces the tolerance" in reference
    assert "-----" not in reference, "a section that docs/api.py did not parse"
    text = html.unescape(re.sub(r"<[^>]*>", "", reference))
    assert "cam_from_world: ArrayLike" in text
    assert re.findall(r"typing\.\w+|numpy\._\w+|clsplat\.\w+\.\w+\.\w+\b(?! import)", text) == [], (
        "an evaluated annotation"
    )
    session = re.search(
        r"<pre>(?:(?!</pre>).)*from clsplat.training.options.density import Mcmc", text_of_code(reference)
    )
    assert session, "a session in Python is not shown as code"
    assert 'id="BudgetOptions.tolerance"' not in reference, "an attribute that the class describes is shown twice"
    linked = set(re.findall(r'href="#([\w.]+)"', reference))
    assert linked <= set(re.findall(r'id="([\w.-]+)"', reference)) | {"#"}


def test_the_reference_has_all_training_options(reference: str) -> None:
    section = reference[reference.index('<section id="TrainConfig">') :].partition("</section>")[0]
    assert [name for name in OPTIONS if f"<li><strong>{name}</strong>:" not in section] == []


def test_docstrings_without_pdoc(tmp_path: Path) -> None:
    if importlib.util.find_spec("pdoc"):
        pytest.skip("pdoc is installed")
    done = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "api.py"), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr == 'error: pdoc is not installed: pip install "clsplat[docs]"\n'
