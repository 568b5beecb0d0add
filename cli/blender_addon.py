"""`clsplat blender-addon`: the Blender add-on as a zip file that Blender installs."""

from __future__ import annotations

import importlib.metadata
import io
import json
import re
import zipfile
from importlib.resources import files
from pathlib import Path

import click

from clsplat import __version__
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_writer
from clsplat.files.existing import refuse_existing

from .command import DocumentedCommand
from .options import PATH, overwrite_option

_MANIFEST = "blender_manifest.toml"
_WHEN = (1980, 1, 1, 0, 0, 0)  # a fixed date, so that the same files make the same zip
# Blender's names of platforms, by patterns for the platform tags of wheels.
_PLATFORMS = {
    r"linux.*x86_64": "linux-x64",
    r"win_amd64": "windows-x64",
    r"win_arm64": "windows-arm64",
    r"macosx.*(arm64|universal2)": "macos-arm64",
    r"macosx.*(x86_64|universal2)": "macos-x64",
}


@click.command(
    cls=DocumentedCommand,
    examples=(("clsplat blender-addon -o clsplat-addon.zip", "Then install the zip in Blender."),),
    see_also=("render",),
)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("clsplat-addon.zip"),
    show_default=True,
    metavar="FILE",
    help="The zip file to write.",
)
@overwrite_option()
@click.option(
    "--wheels",
    type=PATH,
    metavar="DIR",
    help="Folder of wheels to put into the zip, except NumPy's. Blender installs them with the add-on, and already "
    "has NumPy.",
)
def build_addon(output: Path, overwrite: bool, wheels: Path | None) -> None:
    """Build the Blender add-on as a zip: in Blender, Edit > Preferences > Get Extensions > Install from Disk.

    The add-on needs clsplat in Blender's own Python: `PYTHON -m pip install FOLDER_OF_CLSPLAT` with the Python that the
    add-on's preferences name. Or put it into the zip: `pip wheel --wheel-dir DIR .` in clsplat's folder with a
    Python of Blender's version, then `clsplat blender-addon --wheels DIR`.
    """
    refuse_existing([output], overwrite)
    bundled = wheels_in(wheels) if wheels is not None else []
    with atomic_writer(output) as stream:
        stream.write(addon_zip(bundled))
    with_wheels = f" with {len(bundled)} wheels" if bundled else ""
    click.echo(
        f"{output}: add-on {__version__}{with_wheels}; in Blender, Edit > Preferences > Get Extensions > "
        "Install from Disk"
    )


def addon_zip(wheels: list[Path]) -> bytes:
    """Return the bytes of the zip. Equal sources and wheels give equal bytes."""
    contents = {
        entry.name: entry.read_bytes() for entry in files("clsplat_blender").iterdir() if entry.name.endswith(".py")
    }
    contents[_MANIFEST] = manifest(wheels).encode("utf-8")
    licence = importlib.metadata.distribution("clsplat").read_text("licenses/LICENSE")
    if licence:
        contents["LICENSE"] = licence.encode("utf-8")
    contents |= {f"wheels/{wheel.name}": wheel.read_bytes() for wheel in wheels}
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as target:
        for name, data in sorted(contents.items()):
            entry = zipfile.ZipInfo(name, _WHEN)
            entry.external_attr = 0o644 << 16
            stored = zipfile.ZIP_STORED if name.endswith(".whl") else zipfile.ZIP_DEFLATED
            target.writestr(entry, data, stored)
    return archive.getvalue()


def manifest(wheels: list[Path]) -> str:
    """Return the add-on's manifest with clsplat's version, the wheels and their platforms."""
    text = (files("clsplat_blender") / _MANIFEST).read_text("utf-8")
    lines = f'version = "{__version__}"\n'
    if wheels:
        named = json.dumps([f"./wheels/{wheel.name}" for wheel in wheels], indent=2)
        lines += f"wheels = {named}\n"
        platforms = sorted(
            {
                place
                for wheel in wheels
                for pattern, place in _PLATFORMS.items()
                if re.search(pattern, wheel.stem.rsplit("-", 1)[-1])
            }
        )
        if platforms:
            lines += f"platforms = {json.dumps(platforms)}\n"
    head, section, rest = text.partition("[permissions]")
    return head.rstrip() + "\n" + lines + "\n" + section + rest


def wheels_in(folder: Path) -> list[Path]:
    """Return the wheels of a folder, except NumPy's.

    Raises
    ------
    InputError : no such folder, or clsplat's own wheel is not in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; fill it with `pip wheel --wheel-dir DIR .` in clsplat's folder")
    found = sorted(path for path in folder.glob("*.whl") if not path.name.startswith("numpy-"))
    if not any(path.name.startswith("clsplat-") for path in found):
        raise InputError(f"{folder}: has no wheel of clsplat; fill it with `pip wheel --wheel-dir DIR .` in its folder")
    return found
