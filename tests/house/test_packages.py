"""The order of packages, and the files that may name certain things: libraries, shapes, LANES, GROUP."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from draw_imports import imports_of, modules, package_line, package_of

from clsplat.splats.shapes import SHAPES

ROOT = Path(__file__).resolve().parents[2]

# The rule: a package imports only packages to its left, and a package has no circular imports.
PACKAGES = (
    "errors",
    "_version",
    "activity",
    "files",
    "splats",
    "cameras",
    "webpage",
    "scenes",
    "device",
    "rendering",
    "evaluation",
    "training",
    "cluster",
    "compression",
    "blocks",
    "cleaning",
    "models",
    "comparison",
    "benchmark",
    "profiling",
    "viewer",
)
# These three are independent: none imports another.
LAST = ("benchmark", "profiling", "viewer")

# Libraries that only these modules import.
OWNERS = {
    "pyopencl": {
        "device.context",
        "device.device",
        "device.memory",
        "device.opencl",
        "device.program",
        "device.several",
    },
    "pycolmap": {"scenes.undistort"},
    "PIL": {"files.images"},
    "matplotlib": {"evaluation.chart_style"},
    "viser": {
        "viewer.crop_panel",
        "viewer.listen",
        "viewer.measure_panel",
        "viewer.page",
        "viewer.page_download",
        "viewer.path_panel",
        "viewer.server",
    },
    "websockets": {"viewer.listen"},
    "imageio": {"files.video"},
    "imageio_ffmpeg": {"files.video", "scenes.reconstruct.video_frames"},
    "lpips": {"evaluation.perceptual"},
    "torch": {"evaluation.perceptual"},
    "flip_evaluator": {"evaluation.perceptual"},
    "zstandard": {"files.zstd"},
    "distributed": {"cluster.dask"},
    "dask": {"cluster.dask"},
    "click": set(),  # only the command line imports it
}

# Files other than shapes.py and cl/shape/ that may name a shape, and the reason.
SHAPE_NAMES_IN = {
    "splats/convert.py": "which shape's splats are Gaussians of other scales",
    "training/presets.py": "a published system has its kernel",
    "profiling/gpu_counts.py": "whose loops a GPU's compiler has counted; the others follow their operations",
    "rendering/tuning.py": "the cheapest kernel is the one that schedules are measured on",
}

COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)


def kernel_sources() -> dict[str, str]:
    """Return the sources below cl/ by name, without comments."""
    folder = ROOT / "cl"
    return {
        str(path.relative_to(folder)): COMMENT.sub(" ", path.read_text())
        for path in sorted(folder.rglob("*.cl*"))
        if path.suffix in (".cl", ".clh")
    }


def foreign_imports(tree: ast.AST) -> set[str]:
    """Return the external top-level packages that a module imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            found.add(node.module.split(".")[0])
    return found


def code_strings(tree: ast.AST) -> Iterator[str]:
    """Return the string constants that are not docstrings."""
    documents = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            yield node.value


def test_every_package_has_its_place_in_the_line() -> None:
    assert {package_of(name) for name in modules()} == {*PACKAGES, "__init__"}


def test_the_line_of_the_documents_is_the_line_of_the_test() -> None:
    assert tuple(package_line()) == PACKAGES


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_packages_to_their_left(package: str) -> None:
    allowed = set(PACKAGES[: PACKAGES.index(package) + 1]) - (set(LAST) - {package} if package in LAST else set())
    for name, path in modules().items():
        if package_of(name) == package:
            for imported in imports_of(name, path):
                assert package_of(imported) in allowed, f"{name} imports {imported}"


def test_no_import_runs_in_a_circle() -> None:
    arrows = {name: imports_of(name, path) for name, path in modules().items()}
    finished: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, f"a circle: {' -> '.join((*way, name))}"
        if name not in finished:
            for imported in arrows.get(name, ()):
                visit(imported, (*way, name))
            finished.add(name)

    for name in arrows:
        visit(name, ())


def test_no_two_classes_have_one_name() -> None:
    homes: dict[str, list[str]] = {}
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(name)
    assert {name: places for name, places in homes.items() if len(places) > 1} == {}


def test_the_packages_are_installed() -> None:
    """pyproject.toml lists each folder that contains modules."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "clsplat").rglob("*.py")}
    assert {".".join(folder.parts) for folder in folders} == {
        name for name in listed if name.startswith("clsplat.") or name == "clsplat"
    }


@pytest.mark.parametrize("library", OWNERS)
def test_libraries_have_owners(library: str) -> None:
    users = {n for n, path in modules().items() if library in foreign_imports(ast.parse(path.read_text()))}
    assert users == OWNERS[library]


def test_only_shape_files_name_shapes() -> None:
    naming = {
        path.relative_to(ROOT).as_posix().removeprefix("clsplat/")
        for path in (*(ROOT / "clsplat").rglob("*.py"), *(ROOT / "cli").glob("*.py"))
        if path.name != "shapes.py" and set(SHAPES) & set(code_strings(ast.parse(path.read_text())))
    }
    assert naming == set(SHAPE_NAMES_IN)
    words = re.compile("|".join(name.replace("-", "[-_ ]?") for name in SHAPES), re.I)
    for name, text in kernel_sources().items():
        if not name.startswith("shape/"):
            assert not words.search(text), f"{name} names the shape {words.search(text)}"


def test_only_their_own_files_branch_on_lanes_and_group() -> None:
    homes = {
        r"\bLANES\b|\bREAL_DOUBLE\b": {"math/lanes.clh", "math/approx.clh"},
        r"\bGROUP\b": {"render/group.clh"},
    }
    for name, text in kernel_sources().items():
        conditions = [line for line in text.splitlines() if re.match(r"\s*#\s*(if|elif)", line)]
        for words, files in homes.items():
            asking = [line for line in conditions if re.search(words, line)]
            assert bool(asking) == (name in files), f"{name}: {asking}"


def test_blending_constants_live_in_one_file() -> None:
    words = re.compile(r"\b(ALPHA_MIN|ALPHA_MAX|T_MIN)\b")
    assert {name for name, text in kernel_sources().items() if words.search(text)} == {"render/blend.clh"}


def test_kernels_use_no_atomics_and_no_includes() -> None:
    for name, text in kernel_sources().items():
        assert not re.search(r"\batom(ic)?_\w+|#\s*include|cl_khr_(global|local)_\w*atomics", text), name


def test_files_stay_small() -> None:
    """A file has about 300 lines and at most 400."""
    for path in [*modules().values(), *(ROOT / "cl").rglob("*.cl*"), *(ROOT / "cli").glob("*.py")]:
        assert len(path.read_text().splitlines()) <= 400, path.name


# Files of the command line that write a file, and the reason.
COMMANDS_THAT_WRITE = {"blender_addon.py": "the add-on is a part of the command line's package, not of a model"}
WRITERS = {"atomic_writer", "write_text", "write_bytes", "write_json", "savez", "save", "mkdir"}


def names_used(tree: ast.AST) -> set[str]:
    """Return the names of variables, attributes and imports."""
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    names |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    return names | {a.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for a in node.names}


def test_commands_only_parse_call_and_print() -> None:
    """The command line computes and writes nothing itself, so a notebook can do everything that it does."""
    writing = set()
    for path in sorted((ROOT / "cli").glob("*.py")):
        tree = ast.parse(path.read_text())
        assert not foreign_imports(tree) & {"numpy", "scipy", "PIL", "pyopencl", "pycolmap", "matplotlib"}, path.name
        if names_used(tree) & (WRITERS | {"open"}):
            writing.add(path.name)
    assert writing == set(COMMANDS_THAT_WRITE)


def test_the_package_lists_its_names() -> None:
    import clsplat

    assert set(clsplat.__all__) <= set(dir(clsplat))
