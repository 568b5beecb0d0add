"""`clsplat info`: show the contents of models and scenes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .command import DocumentedCommand
from .options import PATH, iteration_option
from .progress import table

if TYPE_CHECKING:
    from clsplat.models.info import ModelInfo
    from clsplat.scenes.info import LensUse, SceneInfo

_MAX_LISTED = 5  # longest list of names that is printed in full


@click.command(
    "info",
    cls=DocumentedCommand,
    examples=(
        ("clsplat info MODEL", "What a model is made of."),
        ("clsplat info SCENE", "What there is to train on."),
    ),
    see_also=("train", "convert"),
)
@click.argument("paths", nargs=-1, required=True, type=PATH)
@iteration_option
@click.option("-i", "--images", metavar="NAME", help="Folder of the photos inside a scene, such as images_4.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one object for each path.")
def show_info(paths: tuple[Path, ...], iteration: int | None, images: str | None, as_json: bool) -> None:
    """Show the contents of PATHS: models (folders or PLY files), or scenes.

    For a model: its splats, skewed splats, SH coefficients, parameters and bytes. For a scene: its photos, lenses,
    points and test views, without decoding a photo.
    """
    from clsplat.models.info import ModelInfo, inspect

    for number, path in enumerate(paths):
        info = inspect(path, iteration=iteration, images=images)
        if as_json:
            kind = "model" if isinstance(info, ModelInfo) else "scene"
            click.echo(json.dumps({kind: str(path), **info.to_json()}))
            continue
        if number:
            click.echo()
        for line in _model_lines(info) if isinstance(info, ModelInfo) else _scene_lines(path, info):
            click.echo(line)


# --- models ------------------------------------------------------------------------------------


def _model_lines(info: ModelInfo) -> list[str]:
    values = info.to_json()
    return [
        f"{info.model.ply}: {values['splats']} splats, shape {values['shape']}, SH degree {values['sh_degree']}, "
        f"{'antialiased, ' if values['antialiased'] else ''}{values['bytes'] / 1e6:.2f} MB",
        *([f"origin at ({_place(values['origin'])}) of the scene's coordinates"] if any(values["origin"]) else []),
        table(("", "in use", "of"), model_rows(values)),
    ]


def model_rows(values: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the rows of the table: name, number in use, total number."""
    n = values["splats"]
    rows = [(f"splats with {name}", str(count), str(n)) for name, count in values["fields_in_use"].items()]
    rows += [
        (f"SH coefficients, band {band}", str(count), str(3 * (2 * band + 1) * n))
        for band, count in enumerate(values["sh_coefficients"])
    ]
    rows.append(("parameters", str(values["parameters_in_use"]), str(values["parameters"])))
    rows.append(("bytes, as a compact PLY file", str(values["compact_bytes"]), str(values["bytes"])))
    return rows


# --- scenes ------------------------------------------------------------------------------------


def _scene_lines(path: Path, info: SceneInfo) -> list[str]:
    rows = scene_rows(info)
    width = max(len(name) for name, _ in rows)
    head = f"{path}: {info.kind}, {info.photos} photos with poses"
    return [head, *(f"{name.ljust(width)}  {text}" for name, text in rows)]


def scene_rows(info: SceneInfo) -> list[tuple[str, str]]:
    """Return the rows of the table: name and contents."""
    rows = [
        (
            "photos",
            f"{', '.join(f'{n} of {w}x{h} px' for (w, h), n in info.sizes) or 'none readable'}, "
            f"{info.photo_bytes / 1e6:.1f} MB",
        )
    ]
    if info.placed:
        placed, photos, error = info.placed
        rows.append(("reconstructed", f"{placed} of {photos} photos, {error:.2f} px off"))
    if info.left_out:
        share = math.ceil(100 * len(info.left_out) / info.photos)
        rows.append(("left out", f"{_list_names(tuple(info.left_out))}, {share} %"))
        rows += [("", reason) for reason in list(info.left_out.values())[:_MAX_LISTED]]
    rows.append(("without a pose", _list_names(info.unregistered) if info.unregistered else "none"))
    rows += [("lens", _lens(lens)) for lens in info.lenses[:_MAX_LISTED]]
    if len(info.lenses) > _MAX_LISTED:
        rows.append(("", f"and {len(info.lenses) - _MAX_LISTED} more lenses"))
    seen = f", each in {info.track_mean:.1f} photos (median {info.track_median:g})" if info.track_mean > 1 else ""
    rows.append(("points", f"{info.points}{seen}"))
    if any(info.origin):
        rows.append(("origin", f"at ({_place(info.origin)}) of the files' coordinates"))
    remaining = info.photos - len(info.left_out) - len(info.test)
    held_out = f"{_list_names(info.test)} with clsplat train --eval; {remaining} remain for training"
    rows.append(("test views", held_out if info.photos > 1 else "none: clsplat train --eval needs at least 2 photos"))
    rows.append(("masks", f"of {info.masked} photos" if info.masked else "none"))
    return rows


def _lens(lens: LensUse) -> str:
    text = (
        f"{'pinhole' if lens.pinhole else lens.model}, {lens.width}x{lens.height} px, focal length "
        f"{lens.focal:.1f} px ({lens.field_of_view:.0f} degrees across): {lens.photos} photos"
    )
    return text if lens.pinhole else f"{text}, undistorted when they are read"


def _place(origin: Sequence[float]) -> str:
    return ", ".join(f"{value:.15g}" for value in origin)


def _list_names(names: tuple[str, ...]) -> str:
    return f"{len(names)} ({', '.join(names[:_MAX_LISTED])}{', ...' if len(names) > _MAX_LISTED else ''})"
