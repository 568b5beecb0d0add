"""`clsplat info`: what a model is made of and how much of it is in use, and what a scene holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from clsplat.errors import InputError
from clsplat.splats.splats import Splats
from clsplat.splats.stats import complexity
from clsplat.training.folder import ModelFolder

from .models import load_model
from .options import PATH, iteration_option
from .progress import table

if TYPE_CHECKING:
    from clsplat.scenes.info import LensUse, SceneInfo

_NAMED = 5  # names that are listed, of many


@click.command("info")
@click.argument("paths", nargs=-1, required=True, type=PATH)
@iteration_option
@click.option("-i", "--images", metavar="NAME", help="Of a scene: the folder of its photos, such as images_4.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one object for each path.")
def show_info(paths: tuple[Path, ...], iteration: int | None, images: str | None, as_json: bool) -> None:
    """Say what PATHS hold: models (folders or PLY files), or scenes.

    Of a model the splats, skewed splats, SH coefficients, parameters and bytes; of a scene its photos, lenses, points
    and test views, without decoding a photo.
    """
    for number, path in enumerate(paths):
        if number and not as_json:
            click.echo()
        if _is_scene(path):
            _show_scene(path, images, as_json)
        else:
            _show_model(path, iteration, as_json)


def _is_scene(path: Path) -> bool:
    from clsplat.scenes.info import is_scene
    from clsplat.scenes.reconstruct.photo_files import is_photographs

    if path.is_file() or not path.is_dir() or ModelFolder(path).iterations():
        return path.is_file() and path.suffix == ".json"
    if is_scene(path):
        return True
    if ModelFolder(path).is_used:
        return False  # a model without a point cloud yet: load_model says so
    if is_photographs(path):
        raise InputError(f"{path}: photographs without poses: clsplat reconstruct {path} -o SCENE finds them")
    raise InputError(f"{path}: neither a model (point_cloud/) nor a scene (sparse/ or transforms.json)")


# --- models ------------------------------------------------------------------------------------


def _show_model(path: Path, iteration: int | None, as_json: bool) -> None:
    loaded = load_model(path, iteration)
    found = described(loaded.splats, loaded.ply)
    if as_json:
        click.echo(json.dumps({"model": str(path), **found}))
        return
    click.echo(
        f"{loaded.ply}: {found['splats']} splats, shape {found['shape']}, SH degree {found['sh_degree']}, "
        f"{'antialiased, ' if found['antialiased'] else ''}{found['bytes'] / 1e6:.2f} MB"
    )
    click.echo(table(("", "in use", "of"), rows_of(found)))


def described(splats: Splats, ply: Path) -> dict[str, Any]:
    """The model's complexity, and the bytes of its file."""
    return {
        "shape": splats.shape,
        "normalisation": splats.normalisation,
        "sh_degree": splats.sh_degree,
        "antialiased": splats.antialiased,
        "bytes": ply.stat().st_size,
        **complexity(splats).to_json(),
    }


def rows_of(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Lines of the table: what, how much of it is in use, and out of how much."""
    n = found["splats"]
    rows = [(f"splats with {name}", str(count), str(n)) for name, count in found["fields_in_use"].items()]
    rows += [
        (f"SH coefficients, band {band}", str(count), str(3 * (2 * band + 1) * n))
        for band, count in enumerate(found["sh_coefficients"])
    ]
    rows.append(("parameters", str(found["parameters_in_use"]), str(found["parameters"])))
    rows.append(("bytes, written compactly", str(found["compact_bytes"]), str(found["bytes"])))
    return rows


# --- scenes ------------------------------------------------------------------------------------


def _show_scene(path: Path, images: str | None, as_json: bool) -> None:
    from clsplat.scenes.info import scene_info

    found = scene_info(path, images)
    if as_json:
        click.echo(json.dumps({"scene": str(path), **found.to_json()}))
        return
    rows = scene_rows(found)
    width = max(len(name) for name, _ in rows)
    click.echo(f"{path}: {found.kind}, {found.photos} photos with poses")
    for name, text in rows:
        click.echo(f"{name.ljust(width)}  {text}")


def scene_rows(found: SceneInfo) -> list[tuple[str, str]]:
    """What, and how much of it."""
    rows = [
        (
            "photos",
            f"{', '.join(f'{n} of {w}x{h} px' for (w, h), n in found.sizes) or 'none readable'}, "
            f"{found.photo_bytes / 1e6:.1f} MB",
        )
    ]
    if found.placed:
        placed, given, error = found.placed
        rows.append(("reconstructed", f"{placed} of {given} photos, {error:.2f} px off"))
    if found.unreadable:
        rows.append(("unreadable", _named(found.unreadable)))
    rows.append(("without a pose", _named(found.unregistered) if found.unregistered else "none"))
    rows += [("lens", _lens(lens)) for lens in found.lenses[:_NAMED]]
    if len(found.lenses) > _NAMED:
        rows.append(("", f"and {len(found.lenses) - _NAMED} lenses more"))
    seen = f", each in {found.track_mean:.1f} photos (median {found.track_median:g})" if found.track_mean > 1 else ""
    rows.append(("points", f"{found.points}{seen}"))
    rows.append(("test views", f"with --eval {_named(found.test)}; {found.photos - len(found.test)} are left to learn"))
    rows.append(("masks", f"of {found.masked} photos" if found.masked else "none"))
    return rows


def _lens(lens: LensUse) -> str:
    text = (
        f"{'pinhole' if lens.pinhole else lens.model}, {lens.width}x{lens.height} px, focal length "
        f"{lens.focal:.1f} px ({lens.field_of_view:.0f} degrees across): {lens.photos} photos"
    )
    return text if lens.pinhole else f"{text}, undistorted when they are read"


def _named(names: tuple[str, ...]) -> str:
    return f"{len(names)} ({', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''})"
