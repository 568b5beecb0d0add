"""The style guide of CONTRIBUTING.md holds in comments, docstrings, documents and names of variables."""

from __future__ import annotations

from pathlib import Path

import english


def test_texts_follow_the_style_guide() -> None:
    paths = english.files([english.ROOT / folder for folder in english.FOLDERS])
    found = [
        f"{path.relative_to(english.ROOT)}:{line}: {complaint}"
        for path in paths
        for line, complaint in english.findings(path)
    ]
    assert found == []


def test_the_checker_finds_what_it_is_for(tmp_path: Path) -> None:
    """A long sentence, a private phrase and a role as an identifier, in Python, OpenCL C and Markdown."""
    long = "This sentence " + "goes on and " * 12 + "ends."
    python = tmp_path / "module.py"
    python.write_text(f'"""{long}"""\n\nmost = 1  # what is none of ours\n')
    assert len(list(english.findings(python))) == 3
    kernel = tmp_path / "kernel.cl"
    kernel.write_text(f"// {long}\nint own = 1;  // mends it\n")
    assert len(list(english.findings(kernel))) == 3
    page = tmp_path / "page.md"
    page.write_text(f"# A title\n\n{long}\n\n```\n{long}\n```\n\n| {long} |\n")
    assert len(list(english.findings(page))) == 1
