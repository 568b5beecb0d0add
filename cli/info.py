"""`clsplat info`: what a model is made of, and how much of it is in use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from clsplat.complexity import complexity
from clsplat.splats import Splats

from .models import load_model
from .options import PATH, iteration_option
from .progress import table


@click.command("info")
@click.argument("models", nargs=-1, required=True, type=PATH)
@iteration_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one object for each model.")
def show_info(models: tuple[Path, ...], iteration: int | None, as_json: bool) -> None:
    """Count the splats, skewed splats, SH coefficients, parameters and bytes of MODELS, folders or PLY files."""
    for number, path in enumerate(models):
        loaded = load_model(path, iteration)
        found = described(loaded.splats, loaded.ply)
        if as_json:
            click.echo(json.dumps({"model": str(path), **found}))
            continue
        if number:
            click.echo()
        click.echo(f"{loaded.ply}: {found['splats']} splats, shape {found['shape']}, SH degree {found['sh_degree']}, "
                   f"{found['bytes'] / 1e6:.2f} MB")
        click.echo(table(("", "in use", "of"), rows_of(found)))


def described(splats: Splats, ply: Path) -> dict[str, Any]:
    """The model's complexity, and the bytes of its file."""
    return {"shape": splats.shape, "normalisation": splats.normalisation, "sh_degree": splats.sh_degree,
            "bytes": ply.stat().st_size, **complexity(splats).to_json()}


def rows_of(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Lines of the table: what, how much of it is in use, and out of how much."""
    n = found["splats"]
    rows = [(f"splats with {name}", str(count), str(n)) for name, count in found["fields_in_use"].items()]
    rows += [(f"SH coefficients, band {band}", str(count), str(3 * (2 * band + 1) * n))
             for band, count in enumerate(found["sh_coefficients"])]
    rows.append(("parameters", str(found["parameters_in_use"]), str(found["parameters"])))
    rows.append(("bytes, written compactly", str(found["compact_bytes"]), str(found["bytes"])))
    return rows
