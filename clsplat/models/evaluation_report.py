"""Reports of evaluated models: the content of the page of `evaluation/report`, from measurements and folders."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

from .._version import __version__
from ..errors import InputError
from ..evaluation.report.page import ModelReport, write_report
from ..training.config import TrainConfig
from .measurements import ModelEvaluation
from .model import LoadedModel

# Options that a report always shows; others are shown only if they differ from their defaults.
_ALWAYS_SHOWN = ("iterations", "cap_max", "seed")


def write_model_report(path: Path, scene: str, measured: Sequence[ModelEvaluation], labels: Sequence[str]) -> Path:
    """Write the report of one model or the comparison of several, and return its path.

    Parameters
    ----------
    scene : the scene's name. labels : one name for each model.

    Raises
    ------
    InputError : the models were measured on different views.
    OutputError : the file cannot be written.
    """
    first = measured[0].result
    what = f"{first['views']} {'' if first['set'] == 'all' else first['set'] + ' '}views of {scene}"
    models = [
        ModelReport(label, _costs(one.result), _facts(one), one.per_view, one.images)
        for label, one in zip(labels, measured, strict=True)
    ]
    return write_report(path, models, what, _protocol_lines(first))


def _protocol_lines(result: dict[str, Any]) -> list[str]:
    metrics = {key: text for key, text in result["protocol"].items() if key != "name"}
    lines = [
        f"Protocol {result['protocol']['name']}. "
        + ". ".join(f"{key}: {text}" for key, text in metrics.items())
        + ". Numbers of different protocols must not be compared. Render times are the median over the views."
    ]
    lines.append(f"On {result['device']}, by clsplat {__version__}, {date.today().isoformat()}.")
    return lines


def _costs(result: dict[str, Any]) -> dict[str, str]:
    return {
        "splats": str(result["splats"]),
        "render [ms]": f"{result['render_ms']:.1f}",
        "MB": f"{result['bytes'] / 1e6:.2f}",
    }


def _facts(measured: ModelEvaluation) -> list[tuple[str, str]]:
    result, model = measured.result, measured.model
    facts = [
        ("file", str(model.ply)),
        (
            "shape",
            f"{result['shape']} ({result['normalisation']})" + (", antialiased" if model.splats.antialiased else ""),
        ),
        ("splats", f"{result['splats']}" + (f", {result['skewed']} of them skewed" if result["skewed"] else "")),
        ("SH degree", str(model.splats.sh_degree)),
        ("bytes", f"{result['bytes']} ({result['compact_bytes']} as a compact PLY file)"),
        ("background", ", ".join(f"{part:g}" for part in result["background"])),
    ]
    if measured.floaters is not None:
        facts.append(("floaters", measured.floaters.describe()))
    return facts + _options(model)


def _options(model: LoadedModel) -> list[tuple[str, str]]:
    """Return training options from config.json: those that a report always shows, and all that are not defaults."""
    if model.folder is None or not model.folder.config_path.is_file():
        return []
    try:
        config = TrainConfig.from_json(model.folder.read_config()["config"]).to_json()
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return []  # 3DGS wrote the file, or a user edited it; the report does not need it.
    defaults = TrainConfig().to_json()
    shown = {key: value for key, value in config.items() if key in _ALWAYS_SHOWN or value != defaults.get(key)}
    return [("options", ", ".join(f"{key.replace('_', '-')} {value}" for key, value in shown.items()))]
