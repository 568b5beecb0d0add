"""Documents are correct: commands and Python run, links work, and quoted messages are in the source.

Each `clsplat` command of a code block, and each example of `--help`, runs alone. Its folder has stand-ins for the names
in it (SCENE, MODEL, ...), and `shortened` gives it few iterations and splats. Other commands are checked for the files
and options that they name.
`NOT_RUN` contains the reason why a command is not run. A command that is neither run nor in `NOT_RUN` fails.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from itertools import pairwise
from pathlib import Path

import click
import draw_imports
import numpy as np
import pytest
from cli_runner import ITERATIONS, run
from clsplat_cli.command import DocumentedCommand
from clsplat_cli.main import COMMANDS, main
from set_folders import as_blender, as_colmap

from clsplat.files.images import image_size, write_png

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text() for page in PAGES}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
INDENTED = re.compile(r"^    ((?:clsplat|python|pytest|pip) .*)$", re.M)

# Commands that are not run here: pattern and reason.
NOT_RUN = (
    (r"python3 -m venv|(\.venv/bin/)?pip install", "installs from the network; the extras it names are checked"),
    (r"(\.venv/bin/)?pytest|\.venv/bin/(ruff|clang-format|mypy)|\.ci/run", "the checks; files they name are checked"),
    (r"python tests/support/english\.py", "a check of every text"),
    (r"python benchmarks/", "hours; test_benchmarks.py runs small ones; script and options are checked"),
    (r"python docs/api\.py", "test_reference.py runs it"),
    (r"python docs/draw_imports\.py", "test_the_drawing_is_up_to_date makes the drawing"),
    (r"(\.venv/bin/)?clsplat devices", "measures schedules; test_device.py and test_cli.py run it"),
    (
        r"dask scheduler|sbatch|srun|clsplat worker|.*--cluster",
        "needs a scheduler; tests/cluster runs them",
    ),
    (
        r"clsplat train .*--device (0:0,0:1|cpu/2)",
        "not every machine has such devices; training/test_batch.py",
    ),
    (r"clsplat reconstruct VIDEO", "no video is here; tests/scenes/test_video_frames.py makes one"),
    (r"clsplat view |clsplat train .*--view", "serves until it is stopped; tests/cli/test_view.py runs it"),
)
# Commands that take minutes, or that resemble a command that is run.
SLOW = re.compile(
    r"clsplat (demo|compare|frontier|benchmark|bench|reconstruct|prune|clean)"
    r"|--(budget|target-psnr|video|config|report)"
    r"|PHOTOS|-r 2|\.splat|gaussians\.ply|-direct"
)
REAL_PHOTOS = Path(os.environ.get("CLSPLAT_DATA") or ROOT.parent / "shared" / "data") / "sceaux_castle"
# Values that replace those of every training command's options.
FEW = {"--iterations": "8", "--cap-max": "60", "--seeds": "0", "--seed": "1"}


def blocks(text: str, language: str) -> list[str]:
    return [body for name, body in FENCE.findall(text) if name == language]


def commands() -> dict[str, str]:
    """Return all commands of code blocks and of examples in `--help` with their pages, without comments."""
    found: dict[str, str] = {}
    for page, text in TEXTS.items():
        lines = [line for body in blocks(text, "sh") for line in body.splitlines()]
        lines += INDENTED.findall(FENCE.sub("", text))
        for line in lines:
            for command in re.sub(r"\s+#.*", "", line).split(" && "):
                if command.strip():
                    found.setdefault(command.strip(), page)
    for name in COMMANDS:
        shown = main.get_command(click.Context(main), name)
        assert isinstance(shown, DocumentedCommand)
        for command, _ in shown.examples:
            found.setdefault(command, f"clsplat {name} --help")
    return found


COMMANDS_SEEN = commands()


def reason_not_run(command: str) -> str | None:
    return next((reason for pattern, reason in NOT_RUN if re.match(pattern, command)), None)


RUN = [command for command in COMMANDS_SEEN if reason_not_run(command) is None]


def shortened(command: str) -> list[str]:
    """Return the command's arguments, with few iterations, splats, seeds and images."""
    words = shlex.split(command.removeprefix(".venv/bin/"))[1:]
    for place, word in enumerate(words[:-1]):
        words[place + 1] = FEW.get(word, words[place + 1])
    if "--resume" in words and "--iterations" in words:  # more than those of the model
        words[words.index("--iterations") + 1] = str(ITERATIONS + 1)
    name = words[0]
    if name in ("train", "partition", "demo", "compare", "frontier", "benchmark") and "--resume" not in words:
        options = {"--iterations", "--cap-max"} - set(words)
        words += [part for option in sorted(options) for part in (option, FEW[option])]
    if name == "demo":
        words += ["--views", "12", "--width", "48"]
    if name == "render" and "--path" in words and "--frames" not in words:
        words += ["--frames", "3"]
    if name == "bench":
        words += [] if "-s" in words else ["--splats", "200", "--width", "64", "--height", "48"]
    return words


def stand_ins(folder: Path, words: list[str], capture: Path, model: Path) -> None:
    """Make the scene, photos and models that a command names."""
    makes = {"train": "-m", "partition": "-m", "reconstruct": "-o"}.get(words[0]) if "--resume" not in words else None
    target = next((after for word, after in pairwise(words) if word == makes), None)
    for name in ("SCENE", "MODEL", "OTHER", "SMALL"):
        if any(name in word.split("/") for word in words) and name != target:
            shutil.copytree(capture if name == "SCENE" else model, folder / name)
    if "llff" in words:
        as_colmap(capture, folder / "SETS" / "fern", "images_8")
    elif "SETS" in words:
        as_blender(capture, folder / "SETS" / "lego")
    if "FILE.ply" in words:
        shutil.copy(max(model.glob("point_cloud/*/point_cloud.ply")), folder / "FILE.ply")
    if "PHOTOS" in words:
        photos = (REAL_PHOTOS if REAL_PHOTOS.is_dir() else capture) / "images"
        shutil.copytree(photos, folder / "PHOTOS")
    if "--masks" in words:
        (photo, *_) = sorted((folder / "SCENE" / "images").iterdir())
        width, height = image_size(photo)
        mask = np.full((height, width), 255, np.uint8)
        mask[:5] = 0
        write_png(folder / "SCENE" / "masks" / f"{photo.name}.png", mask)


@pytest.mark.parametrize(
    "command", [pytest.param(command, marks=[pytest.mark.slow] if SLOW.search(command) else []) for command in RUN]
)
def test_commands_run(
    command: str, tmp_path: Path, capture_folder: Path, model_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert command.removeprefix(".venv/bin/").startswith("clsplat "), (
        f"{COMMANDS_SEEN[command]}: {command!r} is neither run nor in NOT_RUN"
    )
    words = shortened(command)
    if "--video" in words:
        pytest.importorskip("imageio_ffmpeg", reason="imageio[ffmpeg] is not installed (pip install clsplat[video])")
    if ".usd" in command:
        pytest.importorskip("pxr", reason="usd-core is not installed (pip install clsplat[usd])")
    stand_ins(tmp_path, words, capture_folder, model_folder)
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    result = run(*words)
    if "PHOTOS" in words and not REAL_PHOTOS.is_dir():  # photos of the demo scene are too small to match
        assert result.exit_code == 1
        assert "so none has a pose" in result.stderr
        return
    assert result.exit_code == 0, f"{COMMANDS_SEEN[command]}: {command}\n{result.output}"
    assert result.stdout or set(tmp_path.rglob("*")) - before, "no output and no file"


@pytest.mark.parametrize("command", sorted(set(COMMANDS_SEEN) - set(RUN)))
def test_other_commands_name_existing_files_and_options(command: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for named in re.findall(r"(?:clsplat|\.)\[([\w,-]+)\]", command):
        assert set(named.split(",")) <= set(extras)
    words = shlex.split(command)
    for word in words:
        if re.match(r"(tests|benchmarks|docs|\.ci)/", word):
            assert (ROOT / word).exists(), word
    script = next((ROOT / word for word in words if re.match(r"benchmarks/\w+\.py", word)), None)
    if script is not None:
        shown = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, check=True)
        for option in re.findall(r"--[\w-]+", command):
            assert re.search(rf"{option}\b", shown.stdout), f"{script.name} has no {option}"


def options_of(name: str) -> set[str]:
    """Return all options of a command and of the group."""
    command = main.get_command(click.Context(main), name)
    assert command is not None
    return {option for param in (*command.params, *main.params) for option in (*param.opts, *param.secondary_opts)}


def test_options_in_the_text_exist() -> None:
    """Every `--option` in backticks in the guide and the README is an option of some command."""
    known = set().union(*(options_of(name) for name in COMMANDS)) | {"--help"}
    for script in (ROOT / "benchmarks").glob("*.py"):
        known |= set(re.findall(r'"(--[a-z-]+)"', script.read_text()))
    for page, text in TEXTS.items():
        if page.startswith("benchmarks") or page == "CHANGELOG.md":
            continue
        plain = FENCE.sub("", text)
        for span in re.findall(r"`([^`\n]+)`", plain):
            if re.match(r"(-\w |--|clsplat )", span):
                unknown = {option.replace("_", "-") for option in re.findall(r"(?<!\w)--[a-z][\w-]*", span)} - known
                assert not unknown, f"{page}: {span}: no command has {', '.join(unknown)}"
            command = re.match(r"clsplat ([a-z-]+)", span)
            if command:
                assert command[1] in COMMANDS, f"{page}: {span}"
                missing = set(re.findall(r"(?<!\w)--[a-z][\w-]*", span)) - options_of(command[1]) - {"--help"}
                assert not missing, f"{page}: {span}: clsplat {command[1]} has no {', '.join(missing)}"


def test_every_command_is_in_the_guide() -> None:
    guide = "\n".join(text for page, text in TEXTS.items() if page.startswith("docs/") or page == "README.md")
    assert [name for name in COMMANDS if f"clsplat {name}" not in guide] == []


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if blocks(text, "python")])
def test_python_runs(page: str, tmp_path: Path, capture_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All Python of a page runs as one program, in the demo's folder."""
    shutil.copytree(capture_folder, tmp_path / "out" / "scene")
    monkeypatch.chdir(tmp_path)
    source = "\n".join(blocks(TEXTS[page], "python"))
    source = re.sub(r"iterations=\d+", "iterations=8", re.sub(r"cap_max=\d+", "cap_max=60", source))
    exec(compile(source, page, "exec"), {"__name__": "__main__"})


def test_readme_stays_short() -> None:
    assert len(TEXTS["README.md"].splitlines()) <= 150


def test_evidence_is_there() -> None:
    """Each test file in the table "Evidence" exists, and so does each module and kernel that ARCHITECTURE.md names."""
    text = TEXTS["ARCHITECTURE.md"]
    evidence = text[text.index("## Evidence") :]
    files = re.findall(r"`(\w+/test_\w+\.py)`", evidence)
    assert len(files) > 40
    assert [file for file in files if not (ROOT / "tests" / file).exists()] == []
    for page in ("ARCHITECTURE.md", "CONTRIBUTING.md", "docs/kernels.md", "docs/decisions.md"):
        for named in re.findall(r"`((?:clsplat|cl|cli|blender|tests|benchmarks|docs)/(?!test_)[\w/.]+)`", TEXTS[page]):
            assert "NAME" in named or (ROOT / named).exists(), f"{page}: {named}"


def test_the_pipeline_drawing_names_kernels() -> None:
    """The names at the start of each step in the drawing are names of kernels."""
    steps = re.findall(r"^      │ (\w+_\w+(?:, \w+)*|rasterize)(?= )", TEXTS["ARCHITECTURE.md"], re.M)
    sources = "".join(path.read_text() for path in (ROOT / "cl").rglob("*.cl"))
    kernels = {name for step in steps for name in step.split(", ")}
    assert len(kernels) > 12
    assert [name for name in kernels if not re.search(rf"\b{name}\(", sources)] == []


def test_no_import_points_upward_in_the_drawing() -> None:
    heights = draw_imports.positions()
    upward = [arrow for arrow in draw_imports.arrows() if heights[arrow.source] >= heights[arrow.target]]
    assert upward == []


def test_the_drawing_is_up_to_date() -> None:
    assert draw_imports.DRAWING.read_text() == draw_imports.draw(), "run: python docs/draw_imports.py"


def test_the_steps_to_a_shape_name_what_exists() -> None:
    """Each "`NAME` of `file`" of the steps is in the file, and the page of the kernels leads to them."""
    steps = TEXTS["CONTRIBUTING.md"].split("## How to add a shape")[1].split("## How to add a camera")[0]
    named = re.findall(r"`(\w+)`\s+of\s+`((?:tests|clsplat)/[\w/]+\.py)`", steps)
    assert {"RADIAL", "SKEWED", "OWN"} <= {name for name, file in named}
    for name, file in named:
        assert re.search(rf"\b{name}\b", (ROOT / file).read_text()), f"{file} has no {name}"
    assert "random_splats` in" not in steps
    assert "#how-to-add-a-shape" in TEXTS["docs/kernels.md"]


def test_the_page_of_the_kernels_names_what_is_projected() -> None:
    moved = {path.stem for path in (ROOT / "cl/shape").glob("*.clh") if "#define SHAPE_CENTRE" in path.read_text()}
    assert moved == {"skew_normal_direct"}
    assert "In `skew-normal-direct` the *centroid*" in TEXTS["docs/kernels.md"]
    assert "In `bisected-skew` and `half-gaussian` the location (x, y, z) itself" in TEXTS["docs/kernels.md"]


def test_figures_of_other_systems_are_those_of_the_benchmark() -> None:
    published = tomllib.loads((ROOT / "clsplat/benchmark/sets/nerf-synthetic.toml").read_text())["published"]
    figures = [row["psnr"]["lego"] for row in published if row["system"] == "metal-gauss" and len(row["psnr"]) > 1]
    assert f"{figures[0]} dB in its table of all scenes" in " ".join(TEXTS["README.md"].split())


def test_links_work() -> None:
    for page, text in TEXTS.items():
        for target in re.findall(r"\]\(([^)#\s]*)(?:#[^)]*)?\)", text):
            if target and not re.match(r"https?:", target):
                assert ((ROOT / page).parent / target).exists(), f"{page}: {target}"
        for target, anchor in re.findall(r"\]\(([^)#\s]*)#([^)]+)\)", text):
            other = TEXTS[((ROOT / page).parent / target).resolve().relative_to(ROOT).as_posix() if target else page]
            heads = [
                re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-")
                for head in re.findall(r"^#+ (.*)$", other, re.M)
            ]
            assert anchor in heads, f"{page}: {target}#{anchor}"


def source_texts() -> list[str]:
    """Return the text constants of the source, with a NUL for each inserted value."""
    found = []
    for path in [file for folder in ("clsplat", "cli", "blender") for file in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                found.append(
                    "".join(str(part.value) if isinstance(part, ast.Constant) else "\0" for part in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_messages_are_those_of_the_source() -> None:
    """Tables headed "message" quote messages of clsplat. `...`, N, M, WxH and numbers represent inserted values."""
    texts = source_texts()
    quoted = 0
    for page, text in TEXTS.items():
        for table in re.findall(r"^\| message \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.M):
            for row in table.splitlines():
                for message in re.findall(r"`([^`]+)`", row.split(" | ")[0]):
                    quoted += 1
                    message = re.sub(r"^(hint|warning|error): ", "", message)
                    for part in re.split(r"\.\.\.|\b(?:\d+|N|M|WxH)\b", message):
                        words = part.strip(" ',:;")
                        assert len(words) < 3 or any(words in known for known in texts), f"{page}: {words!r}"
    assert quoted > 50
