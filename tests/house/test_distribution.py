"""The wheel and the source archive: what is in them, and that clsplat works from the wheel, without the checkout.

The builder of pyproject.toml comes from the network. The libraries that clsplat needs are those of this Python.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Sequence
from email import message_from_string
from pathlib import Path

import pytest

from clsplat import __version__

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
ABOUT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
FOLDERS = {path: name for name, path in ABOUT["tool"]["setuptools"]["package-dir"].items()}
NOT_IN_ARCHIVE = {".gitignore", ".git-blame-ignore-revs"}  # they are of use in a clone only
NO_NETWORK = re.compile(r"Could not find a version|NewConnectionError|NameResolutionError|No matching distribution")


def run(command: Sequence[str | Path], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without the variables that lead Python to the checkout."""
    hidden = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    return subprocess.run(list(map(str, command)), cwd=folder, env=environment, capture_output=True, encoding="utf-8")


def output_of(command: Sequence[str | Path], folder: Path) -> str:
    """Run a command that must succeed and return its output with its messages."""
    done = run(command, folder)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout[-2000:]}{done.stderr[-3000:]}"
    return done.stdout + done.stderr


def programs(environment: Path) -> Path:
    """Return the folder of the programs of a virtual environment."""
    return environment / ("Scripts" if os.name == "nt" else "bin")


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    """Names of the files of the repository, with new ones that git does not ignore."""
    listed = run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], ROOT)
    if listed.returncode:
        pytest.skip("not a clone of the repository")
    return [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def built(tracked: list[str], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The source archive, and the wheel that is built from it alone."""
    folder = tmp_path_factory.mktemp("build")
    source, builder = folder / "source", folder / "builder"
    for name in tracked:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    venv.create(builder, with_pip=True)
    python = programs(builder) / "python"
    installed = run([python, "-m", "pip", "install", "--quiet", *ABOUT["build-system"]["requires"]], folder)
    if installed.returncode and NO_NETWORK.search(installed.stderr):
        pytest.skip("setuptools cannot be fetched")
    assert installed.returncode == 0, installed.stderr
    backend = ABOUT["build-system"]["build-backend"]
    output_of([python, "-c", f"import {backend} as b; b.build_sdist('../archive')"], source)
    (archive,) = (folder / "archive").iterdir()
    shutil.unpack_archive(archive, folder / "unpacked")
    (unpacked,) = (folder / "unpacked").iterdir()
    said = output_of([python, "-c", f"import {backend} as b; b.build_wheel('../../wheel')"], unpacked)
    assert "absent from the `packages` configuration" not in said, "setuptools guesses what belongs to the packages"
    (wheel,) = (folder / "wheel").iterdir()
    return archive, wheel


@pytest.fixture(scope="module")
def installed(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with the wheel, which borrows the other libraries of this Python."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "venv", with_pip=True)
    python = programs(folder / "venv") / "python"
    output_of([python, "-m", "pip", "install", "--quiet", "--no-deps", built[1]], folder)
    here = sysconfig.get_paths()["purelib"]
    (there,) = (folder / "venv").rglob("site-packages")
    (there / "borrowed.pth").write_text(here + "\n", "utf-8")  # its own .pth files, one for the checkout, do not count
    for library in (Path(sys.prefix) / "lib").glob("lib*.so*"):  # the OpenCL runtime that pip installed
        (folder / "venv" / "lib" / library.name).symlink_to(library)
    return folder / "venv"


def test_the_source_archive_is_the_repository(tracked: list[str], built: tuple[Path, Path]) -> None:
    """Its tests and documents are there, too."""
    with tarfile.open(built[0]) as members:
        names = {member.name.partition("/")[2] for member in members if member.isfile()}
    made = {name for name in names if name.startswith("clsplat.egg-info/")} | {"PKG-INFO", "setup.cfg"}
    assert names - made == set(tracked) - NOT_IN_ARCHIVE


def test_the_wheel_has_all_files_of_the_packages(tracked: list[str], built: tuple[Path, Path]) -> None:
    """Modules, kernels, style sheets, scripts, shaders and tables; the licence; and the version of the package."""
    names = {name: name.partition("/") for name in tracked}
    expected = {f"{FOLDERS[top]}/{rest}" for top, _, rest in names.values() if top in FOLDERS}
    information = f"clsplat-{__version__}.dist-info/"
    with zipfile.ZipFile(built[1]) as wheel:
        found = {name for name in wheel.namelist() if not name.startswith(information)}
        licence = wheel.read(f"{information}licenses/LICENSE")
        about = message_from_string(wheel.read(f"{information}METADATA").decode("utf-8"))
    assert found == expected
    assert licence == (ROOT / "LICENSE").read_bytes()
    assert (about["Name"], about["Version"], about["License-Expression"]) == ("clsplat", __version__, "MIT")


def test_clsplat_works_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    """From a photo to a page and a report, in a folder far from the checkout."""
    program = programs(installed) / "clsplat"
    assert output_of([program, "--version"], tmp_path) == f"clsplat {__version__}\n"
    small = ("--iterations", "20", "--cap-max", "200", "--views", "6", "--width", "48")
    output_of([program, "demo", "out", *small, "--quiet"], tmp_path)
    output_of([program, "render", "out/model", "-o", "images"], tmp_path)
    output_of([program, "convert", "out/model", "scene.html"], tmp_path)
    output_of([program, "eval", "out/model"], tmp_path)
    output_of([program, "blender-addon", "-o", "addon.zip"], tmp_path)
    output_of([program, "benchmark", "--help"], tmp_path)  # it lists the published sets
    made = ("out/model/report.html", "out/model/results.json", "scene.html", "addon.zip")
    assert [name for name in made if not (tmp_path / name).stat().st_size] == []
    assert list((tmp_path / "images").glob("*.png"))
    with zipfile.ZipFile(tmp_path / "addon.zip") as addon:
        assert tomllib.loads(addon.read("blender_manifest.toml").decode("utf-8"))["version"] == __version__
        assert addon.read("LICENSE") == (ROOT / "LICENSE").read_bytes()


def test_nothing_comes_from_the_checkout(installed: Path, tmp_path: Path) -> None:
    code = "import clsplat, clsplat_cl, clsplat_cli, sys; print(clsplat.__file__, *clsplat_cl.__path__, clsplat_cli)"
    shown = output_of([programs(installed) / "python", "-c", code], tmp_path)
    assert str(ROOT) not in shown.replace(str(tmp_path), "")
    assert shown.count(str(installed)) == 3
    code = "from importlib.metadata import version; print(version('clsplat'))"
    assert output_of([programs(installed) / "python", "-c", code], tmp_path) == f"{__version__}\n"
