"""Conversion of a model to another shape or file format, and its loss of image quality."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..cameras.cameras_json import NamedCamera, read_cameras
from ..cameras.path import read_path
from ..errors import InputError
from ..evaluation.evaluate import MAX_PSNR
from ..evaluation.metrics import psnr
from ..files.existing import refuse_existing
from ..rendering.renderer import Renderer
from ..splats.approximate import nearest_of_shape
from ..splats.convert import as_one_of, convert
from ..splats.fields import sh_coefficients
from ..splats.formats.any_file import SPZ_ENDING, WRITTEN, WrittenFormat, check_ending, format_of
from ..splats.formats.page_payload import PAGE_ENDING, PRECISIONS
from ..splats.formats.spz import VERSIONS as SPZ_VERSIONS
from ..splats.formats.streamed_sog import LEVELS, LOD_META, write_streamed_sog
from ..splats.low_pass import LOW_PASS
from ..splats.near_plane import NEAR_PLANE
from ..splats.shapes import GAUSSIAN
from ..splats.splats import Splats
from ..webpage.page import PageContent, write_web_page
from .model import LoadedModel, model_at

_SOME = 1000  # splats of a model that show whether it has nearest splats of a shape; all of them would take seconds


@dataclass(frozen=True)
class ConvertedModel:
    """The result of `convert_model`.

    Attributes
    ----------
    source : the model before. output : the file that was written.
    splats : the model after, before the file rounded it.
    approximate : True if the splats are only the nearest ones of their shape.
    levels : the coarser levels of detail of a streamed SOG, the finest first.
    """

    source: LoadedModel
    output: Path
    splats: Splats
    approximate: bool
    levels: tuple[Splats, ...] = ()

    @property
    def removed(self) -> int:
        """Number of splats that were removed because the shape does not support negative opacity."""
        return len(self.source.splats) - len(self.splats)

    @property
    def is_exact(self) -> bool:
        """Whether the file shows the same images as the model."""
        same_bands = self.splats.sh_degree >= self.source.splats.sh_degree
        return not self.approximate and same_bands and not self.rounds

    @property
    def lacks_near_plane(self) -> bool:
        """Whether the model has a near plane that the file does not hold."""
        return self.splats.near_plane != NEAR_PLANE and not self._written.numbers

    @property
    def lacks_low_pass(self) -> bool:
        """Whether the model has a low pass that the file does not hold."""
        return self.splats.low_pass != LOW_PASS and not self._written.numbers

    @property
    def lacks_antialiasing(self) -> bool:
        """Whether the model is antialiased, and the file does not say so."""
        return self.splats.antialiased and not self._written.antialiased

    @property
    def lacks_bands(self) -> bool:
        """Whether the splats have SH bands above 0, and the file does not hold any."""
        return self.splats.sh_degree > 0 and not self._written.bands

    @property
    def rounds(self) -> bool:
        """Whether the file holds fewer digits than float32."""
        return self._written.rounds

    @property
    def _written(self) -> WrittenFormat:
        return WRITTEN[format_of(self.output)]


@dataclass(frozen=True)
class PageOptions:
    """What a web page has besides the splats.

    Parameters
    ----------
    precision : "compact" rounds every value to one to three bytes; "full" keeps float32.
    cameras : a cameras.json with the cameras to jump to; by default that of the model folder.
    camera_path : a camera path that the page plays; by default an ellipse around the scene.
    title : heading of the page; by default the name of the model.
    """

    precision: str = PRECISIONS[0]
    cameras: Path | None = None
    camera_path: Path | None = None
    title: str | None = None


@dataclass(frozen=True)
class ConversionCost:
    """PSNR of the file's images against the model's images: mean and worst [dB] over a number of cameras."""

    mean: float
    worst: float
    cameras: int


def convert_model(
    model: str | os.PathLike[str] | LoadedModel,
    output: str | os.PathLike[str],
    shape: str | None = None,
    *,
    approximate: bool = False,
    sh_degree: int | None = None,
    spz_version: int | None = None,
    levels: int | None = None,
    page: PageOptions | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
) -> ConvertedModel:
    """Write a model as another shape, in another file format or as a web page, and return the conversion.

    Parameters
    ----------
    model : a model folder or a file of splats, or what `load_model` returned.
    output : a .ply file with all columns, a .splat, .spz, .sog, .glb or USD file (.usd, .usda, .usdc, .usdz), or an
        .html page that draws the splats; or a file lod-meta.json, which gets the chunks of a streamed SOG beside it.
    shape : the shape to convert to; by default the model's, or an equal one that the format holds: Gaussians, in .glb
        and USD files and pages skew-normals and generalised exponentials too.
    approximate : use the nearest splat of the shape for splats without an equal one, instead of raising.
    sh_degree : remove the SH bands above, or add bands of zeros.
    spz_version : version of an .spz file, 3 or 4. Version 4 needs the extra `spz`.
    levels : number of levels of detail of a streamed SOG, 1 to 8; by default 4.
    page : what a page has besides the splats.
    iteration : as for `load_model`.
    overwrite : replace an existing file.

    Raises
    ------
    InputError : some splats cannot be converted exactly, or the format does not support the shape.
    OutputError : the file exists, has an unknown ending or cannot be written.
    """
    output = Path(output)
    suffix = check_ending(output)
    if spz_version is not None and suffix != SPZ_ENDING:
        raise InputError(f"{output}: the version is of .spz files: leave it out, or choose the ending .spz")
    if levels is not None and suffix != LOD_META:
        raise InputError(f"{output}: levels are of streamed SOG: leave them out, or name the file {LOD_META}")
    if page is not None and suffix != PAGE_ENDING:
        raise InputError(
            f"{output}: precision, camera path and title are of pages: leave them out, or choose the ending .html"
        )
    refuse_existing([output], overwrite)
    source = model_at(model, iteration)
    shapes = WRITTEN[suffix].shapes
    if shapes is not None and shape is not None and shape not in shapes:
        raise InputError(
            f"{output}: {suffix} files hold {', '.join(shapes)} splats: leave --shape out, or write a .ply"
        )
    converted, is_nearest = _as_shape(source.splats, shape, suffix, approximate)
    if sh_degree is not None:
        converted = _of_degree(converted, sh_degree)
    coarser: list[Splats] = []
    if suffix == PAGE_ENDING:
        _write_page(output, source, converted, page or PageOptions())
    elif suffix == LOD_META:
        coarser = _write_levels(output, converted, LEVELS if levels is None else levels)
    else:
        converted.save(output, spz_version=SPZ_VERSIONS[0] if spz_version is None else spz_version)
    return ConvertedModel(source, output, converted, is_nearest, tuple(coarser))


def conversion_cost(
    converted: ConvertedModel, cameras: Path | None = None, device: str | None = None
) -> ConversionCost | None:
    """Return the PSNR between images of the written file and images of the model.

    Parameters
    ----------
    cameras : a cameras.json; by default that of the model folder.
    device : OpenCL device, as for `Renderer`.

    Returns
    -------
    The cost, or None if there are no cameras.
    """
    costs = _costs(converted, [Splats.load(converted.output)], cameras, device)
    return costs[0] if costs else None


def level_costs(
    converted: ConvertedModel, cameras: Path | None = None, device: str | None = None
) -> list[ConversionCost]:
    """Return the PSNR of the images of each coarser level; parameters as for `conversion_cost`.

    The rounding of the files is not in it. Without cameras, the list is empty.
    """
    return _costs(converted, converted.levels, cameras, device)


def _costs(
    converted: ConvertedModel, written: Sequence[Splats], cameras: Path | None, device: str | None
) -> list[ConversionCost]:
    source = converted.source
    named = _cameras(source, cameras)
    if not named or not written:
        return []
    renderer = Renderer(device, keep=1 + len(written))
    values: list[list[float]] = [[] for _ in written]
    for entry in named:  # one camera at a time: the images of all may be larger than memory
        before = renderer.render(source.splats, entry.camera, source.background).color
        for splats, of_file in zip(written, values, strict=True):
            after = renderer.render(splats, entry.camera, source.background).color
            of_file.append(min(psnr(before, after), MAX_PSNR))
    return [ConversionCost(sum(each) / len(each), min(each), len(each)) for each in values]


def _cameras(source: LoadedModel, path: Path | None) -> list[NamedCamera]:
    return source.read_cameras() if path is None else read_cameras(path)


def _write_page(output: Path, source: LoadedModel, splats: Splats, page: PageOptions) -> None:
    path = None if page.camera_path is None else read_path(page.camera_path)
    content = PageContent(page.title or source.path.name, _cameras(source, page.cameras), path, source.background)
    write_web_page(output, splats, content, page.precision)


def _write_levels(output: Path, splats: Splats, levels: int) -> list[Splats]:
    """Write a streamed SOG and return its coarser levels."""
    return [splats.with_arrays(level.arrays) for level in write_streamed_sog(output, splats.stored(), levels)[1:]]


def _as_shape(splats: Splats, target: str | None, suffix: str, approximate: bool) -> tuple[Splats, bool]:
    """Return the splats as `target`, and whether they are only the nearest ones of that shape.

    Without a target, they get an equal shape that files of this ending hold, or become Gaussians.
    """
    shapes = WRITTEN[suffix].shapes
    try:
        if target is not None:
            return convert(splats, target), False
        holder = "a page draws" if suffix == PAGE_ENDING else f"a {suffix} file holds"
        return (splats if shapes is None else as_one_of(splats, shapes, holder)), False
    except InputError as error:
        if not approximate:
            nearest = "; or --approximate" if _has_nearest(splats, target or GAUSSIAN.name) else ""
            raise InputError(f"{error}{nearest}") from None
    return nearest_of_shape(splats, target or GAUSSIAN.name)


def _has_nearest(splats: Splats, shape: str) -> bool:
    """Return whether another shape has nearest splats, by finding some: the reasons against it are of many kinds."""
    some = splats.select(np.arange(0, len(splats), len(splats) // _SOME + 1))
    try:
        nearest_of_shape(some, shape)
    except InputError:
        return False
    return True


def _of_degree(splats: Splats, degree: int) -> Splats:
    """Return the splats with an SH degree: higher bands are removed, missing bands are zero."""
    sh = splats.sh[:, : sh_coefficients(degree)]
    sh = np.pad(sh, ((0, 0), (0, sh_coefficients(degree) - sh.shape[1]), (0, 0)))
    return splats.with_arrays(splats.to_numpy() | {"sh": sh})
