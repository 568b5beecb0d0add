"""The house keeps its order: who may import whom, who may name a shape, who may ask for LANES or GROUP."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from clsplat.splats.shapes import SHAPES

ROOT = Path(__file__).resolve().parents[2]

# A module imports modules of lower floors only.
FLOORS = """
    capture_world compare_table errors eval_script flops harmonics interrupt morton runtime schema viewer_queue \
    viewer_settings
    arithmetic atomic budget_rules camera device json_fields metrics optim_reference perceptual plan ply_header \
    presets profiles reconstruct_options rotations schedules sfm_process signatures validity
    binaries cameras_json checkpoint colmap_files frontier_data html_report images launches looked_at noise \
    optim_lazy paths_between ply_body ply_compact run_log shapes sole_writer video
    camera_path capture chart_style frontier_tables masks opacities ply program progress_display sghmc skew_map \
    viewer_start
    adc charts config densify eval_histogram frontier_charts kernels lens photo_folder regularisers splats \
    viewer_camera viewer_recording
    blocks buffers colmap complexity convert model_folder paths_around rate_limits sfm splat_file spz_file \
    strategy systems video_frames
    budget_state flat_model gradients limits nearest optim_rules optim_waiting placing point_cloud posed sort
    binning camera_files optim_fused optim_host reconstruct stages transforms
    optim pipeline scene
    loss memory pairs random_points scene_info synthetic truths tuning validation view_sampler
    initialise photos render
    display evaluate needs
    eval_images prune trainer viewer_source
    bench compare eval_report shrink training viewer
    budget frontier viewer_page viewer_training
    viewer_server
"""
FLOOR = {name: level for level, line in enumerate(FLOORS.split("\n")) for name in line.split()}

# Libraries that only these modules import.
OWNERS = {
    "pyopencl": {"buffers", "device", "program", "truths"},
    "pycolmap": {"lens"},
    "PIL": {"images"},
    "matplotlib": {"chart_style"},
    "viser": {"viewer_page", "viewer_server"},
    "imageio": {"video"},
    "imageio_ffmpeg": {"video", "video_frames"},
    "lpips": {"perceptual"},
    "torch": {"perceptual"},
    "flip_evaluator": {"perceptual"},
    "click": set(),  # the command line's
}

# Files beside shapes.py and cl/shape/ that may name a shape, and why.
SHAPE_NAMES_IN = {
    "convert.py": "which shape's splats are Gaussians of other scales",
    "presets.py": "a published system has its kernel",
    "tuning.py": "the cheapest kernel is the one that schedules are measured on",
}

COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.S)


def modules() -> dict[str, Path]:
    return {path.stem: path for path in sorted((ROOT / "clsplat").glob("*.py"))}


def kernel_sources() -> dict[str, str]:
    """Sources below cl/ by name, without comments."""
    folder = ROOT / "cl"
    return {
        str(path.relative_to(folder)): COMMENT.sub(" ", path.read_text())
        for path in sorted(folder.rglob("*.cl*")) if path.suffix in (".cl", ".clh")
    }  # fmt: skip


def own_imports(tree: ast.AST) -> Iterator[str]:
    """Modules of the package that a module imports, lazily or not."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            yield from [node.module] if node.module else [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom | ast.Import):
            named = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            assert not any(name.split(".")[0].startswith("clsplat") for name in named), "import relatively"


def foreign_imports(tree: ast.AST) -> set[str]:
    """Top-level packages from elsewhere that a module imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            found.add(node.module.split(".")[0])
    return found


def code_strings(tree: ast.AST) -> Iterator[str]:
    """String constants that are not docstrings."""
    documents = {
        id(node.body[0].value) for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and node.body
        and isinstance(node.body[0], ast.Expr)
    }  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            yield node.value


def test_every_module_has_a_floor() -> None:
    assert set(FLOOR) == set(modules()) - {"__init__"}


@pytest.mark.parametrize("name", FLOOR)
def test_modules_import_lower_floors_only(name: str) -> None:
    tree = ast.parse(modules()[name].read_text())
    for imported in own_imports(tree):
        if imported != "__version__":
            assert FLOOR[imported] < FLOOR[name], f"{name} (floor {FLOOR[name]}) imports {imported}"


def test_floors_are_no_higher_than_they_must_be() -> None:
    """Each floor has a module that needs it: else the table would promise an order that is not there."""
    for level in sorted(set(FLOOR.values()))[1:]:
        names = [name for name, floor in FLOOR.items() if floor == level]
        trees = [ast.parse(modules()[name].read_text()) for name in names]
        below = {FLOOR.get(imported) for tree in trees for imported in own_imports(tree)}
        assert level - 1 in below, f"{', '.join(names)} on floor {level}: none needs floor {level - 1}"


@pytest.mark.parametrize("library", OWNERS)
def test_libraries_have_owners(library: str) -> None:
    users = {n for n, path in modules().items() if library in foreign_imports(ast.parse(path.read_text()))}
    assert users == OWNERS[library]


def test_only_shape_files_name_shapes() -> None:
    naming = {
        path.name for path in (*modules().values(), *(ROOT / "cli").glob("*.py"))
        if path.name != "shapes.py" and set(SHAPES) & set(code_strings(ast.parse(path.read_text())))
    }  # fmt: skip
    assert naming == set(SHAPE_NAMES_IN)
    words = re.compile("|".join(name.replace("-", "[-_ ]?") for name in SHAPES), re.I)
    for name, text in kernel_sources().items():
        if not name.startswith("shape/"):
            assert not words.search(text), f"{name} names the shape {words.search(text)}"


def test_only_their_own_files_branch_on_lanes_and_group() -> None:
    homes = {"math/lanes.clh": r"\bLANES\b|\bREAL_DOUBLE\b", "render/group.clh": r"\bGROUP\b"}
    for name, text in kernel_sources().items():
        conditions = [line for line in text.splitlines() if re.match(r"\s*#\s*(if|elif)", line)]
        for home, words in homes.items():
            asking = [line for line in conditions if re.search(words, line)]
            assert bool(asking) == (name == home), f"{name}: {asking}"


def test_blending_constants_live_in_one_file() -> None:
    words = re.compile(r"\b(ALPHA_MIN|ALPHA_MAX|T_MIN)\b")
    assert {name for name, text in kernel_sources().items() if words.search(text)} == {"render/blend.clh"}


def test_kernels_use_no_atomics_and_no_includes() -> None:
    for name, text in kernel_sources().items():
        assert not re.search(r"\batom(ic)?_\w+|#\s*include|cl_khr_(global|local)_\w*atomics", text), name


def test_files_stay_small() -> None:
    """About 300 lines a file, 400 at most."""
    for path in [*modules().values(), *(ROOT / "cl").rglob("*.cl*"), *(ROOT / "cli").glob("*.py")]:
        assert len(path.read_text().splitlines()) <= 400, path.name
