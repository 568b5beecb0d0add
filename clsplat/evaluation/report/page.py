"""The page that `clsplat eval` writes: measurements of one or several models, with their images."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.html_page import Section, escape, package_text, write_page
from ...files.image_names import match_names
from .histogram import histogram, quantile
from .images import LONGEST, ComparedImage, colour_stops, data_uri, full_scale, map_of, veiled

IMAGE_BYTES = 16_000_000  # approximate limit of all images of a page; at least one view is shown
_WORST = 8  # number of views with the lowest PSNR that are always shown; the others are spread evenly
_DIGITS = {"PSNR": 2, "SSIM": 4, "LPIPS": 4, "FLIP": 4}
_UNITS = {"PSNR": "PSNR [dB]"}
_LESS_IS_BETTER = ("LPIPS", "FLIP")


@dataclass(frozen=True, eq=False)
class ModelReport:
    """Measurements of one model.

    Parameters
    ----------
    label : name of the model in tables.
    costs : cells of the first table by their headings, beside the means of the metrics.
    facts : rows of a table: name and value.
    per_view : values by metric ("PSNR", "SSIM", and "LPIPS" and "FLIP" if measured) and view.
    images : by view.
    """

    label: str
    costs: Mapping[str, str]
    facts: Sequence[tuple[str, str]]
    per_view: Mapping[str, Mapping[str, float]]
    images: Mapping[str, ComparedImage]

    def mean(self, metric: str) -> float:
        """Mean of a metric over the views."""
        return statistics.fmean(self.per_view[metric].values())

    @property
    def counts(self) -> NDArray[np.int64]:
        """(LEVELS,) number of values of all views by their error."""
        return np.sum([image.counts for image in self.images.values()], axis=0)


def _with_names_of(first: ModelReport, model: ModelReport, path: Path) -> ModelReport:
    """Return the model with the names of the first one's views; InputError if it was measured on others."""
    named = match_names(list(first.images), list(model.images))
    if named is None or any(image.size != first.images[named[name]].size for name, image in model.images.items()):
        raise InputError(
            f"{path}: {model.label} and {first.label} were measured on different views or sizes; "
            "compare models of one scene, or measure them one by one"
        )
    per_view = {metric: {named[name]: values[name] for name in values} for metric, values in model.per_view.items()}
    images = {named[name]: image for name, image in model.images.items()}
    return replace(model, per_view=per_view, images=images)


def write_report(path: Path, models: Sequence[ModelReport], what: str, protocol: Sequence[str]) -> Path:
    """Write the page and return its path.

    Parameters
    ----------
    models : measured on the same views with the same protocol.
    what : the views, such as "6 test views of fox".
    protocol : paragraphs on how the metrics were computed.

    Raises
    ------
    InputError : the models were measured on different views.
    OutputError : the page cannot be written.
    """
    names = list(models[0].images)
    models = [models[0], *(_with_names_of(models[0], model, path) for model in models[1:])]
    psnr = {name: statistics.fmean(model.per_view["PSNR"][name] for model in models) for name in names}
    worst_first = sorted(names, key=lambda name: psnr[name])
    all_images = [image for model in models for image in model.images.values()]
    full = full_scale(all_images)
    shown = _views(models, worst_first, full)
    many = len(models) > 1
    title = f"{what}: " + (f"{len(models)} models" if many else models[0].label)
    low, high = psnr[worst_first[0]], psnr[worst_first[-1]]
    summary = [
        f"PSNR {low:.2f} to {high:.2f} dB{' (means over the models)' if many else ''}; "
        f"the worst view is {worst_first[0]}."
    ]
    sections = [
        Section(
            "Means",
            summary,
            head=("model", *(_UNITS.get(m, m) for m in _metrics(models)), *models[0].costs),
            lines=[
                (model.label, *(_number(m, model.mean(m)) for m in _metrics(models)), *model.costs.values())
                for model in models
            ],
        ),
        Section(
            "Views", ["Worst first; a click on a heading sorts by it."], markup=_view_table(models, worst_first, shown)
        ),
        Section("Images", _about_images(all_images, len(shown), len(names), full), markup="".join(shown.values())),
        Section(
            "Errors",
            [_spread(model) for model in models],
            markup=histogram([model.label for model in models], [model.counts for model in models]),
        ),
        Section(
            "How it was measured",
            [
                *protocol,
                *(
                    ["Pixels that a mask hides are left out of all numbers."]
                    * any(image.hidden is not None for image in all_images)
                ),
            ],
        ),
        *(Section(model.label if many else "Model", lines=model.facts, head=("", "")) for model in models),
    ]
    style, script = (package_text(__package__, f"report.{kind}") for kind in ("css", "js"))
    return write_page(path, title, sections, style, script)


def _metrics(models: Sequence[ModelReport]) -> list[str]:
    return [metric for metric in _DIGITS if metric in models[0].per_view]


def _number(metric: str, value: float) -> str:
    return f"{value:.{_DIGITS[metric]}f}"


def _about_images(images: Sequence[ComparedImage], shown: int, n: int, full: float) -> list[str]:
    text = ["Drag over an image, or use the arrow keys, to wipe between the render and the photo."]
    text.append(
        f"Error maps: absolute difference, mean of the channels, all on one scale; {full:g} of the full range "
        "and more is brightest."
    )
    if any(image.hidden is not None for image in images):
        text.append("Masked pixels are striped.")
    if shown < n:
        text.append(
            f"{shown} of {n} views are shown: the {min(_WORST, shown)} worst, and others spread evenly, "
            f"as far as {IMAGE_BYTES / 1e6:g} MB go."
        )
    if any(max(image.size) >= LONGEST for image in images):
        text.append(f"Images are reduced to {LONGEST} pixels at most; numbers are of whole images.")
    return text


def _spread(model: ModelReport) -> str:
    median, high = quantile(model.counts, 0.5), quantile(model.counts, 0.95)
    return f"{model.label}: half of the values are within {median} of 255 of the photo's, 95 % within {high}."


# --- the table of views ------------------------------------------------------------------------


def _view_table(models: Sequence[ModelReport], names: Sequence[str], shown: Mapping[str, str]) -> str:
    metrics = _metrics(models)
    columns = [(metric, model) for metric in metrics for model in models]
    heads = [
        "view",
        *(_UNITS.get(metric, metric) + (f", {model.label}" if len(models) > 1 else "") for metric, model in columns),
    ]
    first = " aria-sort=ascending" if len(models) == 1 else ""
    head = "".join(
        f'<th scope="col"{" class=text" if place == 0 else ""}{first if place == 1 else ""}>'
        f"<button type=button>{escape(text)}</button></th>"
        for place, text in enumerate(heads)
    )
    body = ""
    for name in names:
        cells = ""
        for metric, model in columns:
            value = model.per_view[metric][name]
            rivals = [other.per_view[metric][name] for other in models]
            best = len(models) > 1 and value == (min if metric in _LESS_IS_BETTER else max)(rivals)
            cells += f'<td data-value="{value!r}"{" class=best" if best else ""}>{_number(metric, value)}</td>'
        text = f'<a href="#{_anchor(names, name)}">{escape(name)}</a>' if name in shown else escape(name)
        body += f'<tr><th scope="row" class="text" data-value="{escape(name)}">{text}</th>{cells}</tr>\n'
    return (
        f'<div class="table"><table class="sortable"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>\n"
    )


# --- the images --------------------------------------------------------------------------------


def _views(models: Sequence[ModelReport], worst_first: Sequence[str], full: float) -> dict[str, str]:
    """HTML of the views that the page has room for, by name, worst first."""
    candidates = [*worst_first[:_WORST], *_spread_evenly(worst_first[_WORST:])]
    stops = colour_stops()
    shown: dict[str, str] = {}
    used = 0
    for name in candidates:
        markup = _view(models, name, full, stops, _anchor(worst_first, name))
        if shown and used + len(markup) > IMAGE_BYTES:
            break
        shown[name] = markup
        used += len(markup)
    return {name: shown[name] for name in worst_first if name in shown}


def _anchor(worst_first: Sequence[str], name: str) -> str:
    return f"view-{worst_first.index(name) + 1}"


def _spread_evenly(names: Sequence[str]) -> list[str]:
    """All names in an order whose every beginning is spread over the whole: halves, quarters, eighths."""
    order: list[int] = []
    step = 1
    while step < 2 * len(names):
        order += [(2 * part + 1) * len(names) // (2 * step) for part in range(step)]
        step *= 2
    return [names[place] for place in dict.fromkeys(order) if place < len(names)]


def _view(models: Sequence[ModelReport], name: str, full: float, stops: str, anchor: str) -> str:
    numbers = "; ".join(
        (f"{model.label}: " if len(models) > 1 else "")
        + ", ".join(f"{metric} {_number(metric, model.per_view[metric][name])}" for metric in _metrics(models))
        for model in models
    )
    width, height = models[0].images[name].size
    parts = [_wipe(models, name)]
    for model in models:
        image, of = model.images[name], f" of {model.label}" if len(models) > 1 else ""
        parts.append(_map(data_uri(map_of(image.error, full, image.hidden)), f"Error{of}", name, stops, full))
        if image.flip is not None:
            parts.append(_map(data_uri(map_of(image.flip, 1.0, image.hidden)), f"FLIP{of}", name, stops, 1.0))
    return (
        f'<h3 id="{anchor}">{escape(name)} <small>{escape(numbers)}</small></h3>\n'
        f'<div class="images" style="--shape: {width / height:.4f}">{"".join(parts)}</div>\n'
    )


def _wipe(models: Sequence[ModelReport], name: str) -> str:
    first = models[0].images[name]
    width, height = first.size
    sides = [(model.label if len(models) > 1 else "render", model.images[name].render) for model in models]
    images = ""
    for key, (label, picture) in enumerate([*sides, ("photo", first.photo)]):
        side = "over" if key == 0 else "under" if key == len(models) else ""
        images += (
            f'<img data-key="{key}" class="{side}" width="{width}" height="{height}" '
            f'alt="{escape(name)}, {escape(label)}" src="{data_uri(veiled(picture, first.hidden))}">'
        )
    labels = [label for label, _ in sides] + ["photo"]
    if len(models) > 1:
        caption = "".join(_choice(labels, chosen, side) for chosen, side in ((0, "left"), (len(models), "right")))
    else:
        caption = "<span>render</span><span>photo</span>"
    return (
        f'<figure><div class="wipe" style="aspect-ratio: {width} / {height}">{images}'
        f'<input type="range" min="0" max="100" step="any" value="50" autocomplete="off" '
        f'aria-label="Wipe between two images of {escape(name)}"></div>'
        f'<figcaption class="sides">{caption}</figcaption></figure>\n'
    )


def _choice(labels: Sequence[str], chosen: int, side: str) -> str:
    options = "".join(
        f'<option value="{key}"{" selected" if key == chosen else ""}>{escape(label)}</option>'
        for key, label in enumerate(labels)
    )
    return f'<select autocomplete="off" aria-label="Image on the {side}">{options}</select>'


def _map(uri: str, title: str, name: str, stops: str, full: float) -> str:
    return (
        f'<figure><div class="map"><img alt="{escape(title)}, {escape(name)}" src="{uri}"></div>'
        f'<div class="bar" style="background: linear-gradient(90deg, {stops})"></div>'
        f'<figcaption class="sides"><span>0</span><span>{escape(title)}</span><span>{full:g}</span></figcaption>'
        f"</figure>\n"
    )
