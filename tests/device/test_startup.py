"""Start-up: the imports of a command, and processes that start together or with a damaged cache."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from clsplat_cli.main import COMMANDS

from clsplat.device.device import list_devices
from clsplat.device.program import OPTIONS_VARIABLE
from clsplat.device.program_cache import SELF_CACHING

USABLE = [info for info in list_devices() if info.fault is None and info.platform != "Oclgrind"]
PROCESSES = 4

# The child prints the digest of a small image.
CHILD = """
import hashlib, sys
import numpy as np
from clsplat.cameras.camera import Camera
from clsplat.device.device import open_device
from clsplat.device.schedule import default_schedule
from clsplat.rendering.renderer import Renderer
from clsplat.splats.splats import Splats
rng = np.random.default_rng(0)
splats = Splats("gaussian", {"mean": rng.uniform(-1, 1, (50, 3)), "quat": rng.standard_normal((50, 4)),
    "log_scale": np.full((50, 3), -2.0), "opacity_logit": np.zeros(50), "sh": rng.standard_normal((50, 1, 3))})
pose = np.eye(4)
pose[2, 3] = 4
device = open_device(sys.argv[1])
image = Renderer(device, schedule=default_schedule(device.info)).render(splats, Camera(40, 30, 40, 40, 20, 15, pose))
assert image.color.max() > 0.1
print(hashlib.sha256(image.color.tobytes()).hexdigest())
"""


def start(device: str, cache: Path) -> subprocess.Popen[str]:
    """Start a process that renders, with its caches in the folder."""
    environment = os.environ | {
        "XDG_CACHE_HOME": str(cache),
        "POCL_CACHE_DIR": str(cache / "pocl"),
        OPTIONS_VARIABLE: "-cl-opt-disable",  # builds faster
    }
    (cache / "pocl").mkdir(parents=True, exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, device],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def digest(process: subprocess.Popen[str]) -> str:
    """Return the output of a process. It must succeed and print no warning."""
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert errors == ""
    assert len(out.strip()) == 2 * hashlib.sha256().digest_size
    return out


@pytest.mark.parametrize("index", [info.index for info in USABLE], ids=[info.platform.split()[0] for info in USABLE])
def test_processes_share_an_empty_and_a_damaged_cache(index: str, tmp_path: Path) -> None:
    first = {digest(process) for process in [start(index, tmp_path) for _ in range(PROCESSES)]}
    assert len(first) == 1
    cached = sorted((tmp_path / "clsplat" / "programs").glob("*"))
    platform = next(info.platform for info in USABLE if info.index == index)
    assert bool(cached) == (platform not in SELF_CACHING)
    assert all(path.suffix == ".bin" for path in cached), "no temporary file is left"
    for path in cached:
        path.write_bytes(path.read_bytes()[:1000])
    assert {digest(start(index, tmp_path))} == first
    assert all(path.stat().st_size > 1000 for path in cached), "written again"


def test_help_imports_neither_numpy_nor_opencl() -> None:
    """Heavy imports would make the help slow on every machine."""
    check = (
        "import sys; from clsplat_cli.main import main\n"
        "try: main(['--help'])\nexcept SystemExit: print([m for m in ('numpy', 'pyopencl', 'PIL') "
        "if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_does_not_import_opencl(name: str) -> None:
    check = (
        "import sys; from clsplat_cli.main import main\n"
        f"try: main(['{name}', '--help'])\nexcept SystemExit: print([m for m in ('pyopencl', 'scipy', 'PIL', "
        "'pycolmap') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "[]"
