"""Splats in glTF files: the extension KHR_gaussian_splatting, and two kernel extensions of clsplat inside it.

Specification: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting. A splat is
a point of a primitive, with rotation (x, y, z, w), standard deviations, opacity 0..1 and the SH coefficients as they
are. It has the axes of glTF: x left, y up, z forward.

The specification lets an extension add a kernel, and a reader that does not know it draws the ellipse. docs/gltf.md
describes ours:

    CLSPLAT_gaussian_splatting_kernel_skew_normal               kernel "skewNormal", attribute SKEW
    CLSPLAT_gaussian_splatting_kernel_generalised_exponential   kernel "generalisedExponential", attribute BETA

The ellipse of a skew-normal has its mean, its covariance and its peak. So one more attribute makes it exact.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._version import __version__
from ...errors import InputError, named_place
from ..activated import EXTRA_FIELDS, OPACITY, SCALE, activated, placed, raw_arrays
from ..axes import LUF
from ..fields import MAX_SH_DEGREE, Array, DoubleArray, public_shape, sh_coefficients
from ..harmonics import SH_C0
from ..low_pass import LOW_PASSES
from ..near_plane import NEAR_PLANES
from ..shapes import GAUSSIAN, GENERALISED_EXPONENTIAL, NORMALISATIONS, SKEW_NORMAL, Shape, shape_named
from ..stored import StoredSplats, joined_parts
from .glb import GltfFile, Json, read_gltf, write_glb
from .gltf_scene import scene_primitives

GLB_ENDING, GLTF_ENDING = ".glb", ".gltf"
EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0
_ELLIPSE = "ellipse"
_SRGB, _LINEAR = "srgb_rec709_display", "lin_rec709_display"
_EXTRAS = "clsplat"  # of the primitive: what no extension has a place for
_QUANTISED = "KHR_mesh_quantization"  # whole numbers as positions, which the accessors of every attribute may have


# The value of `kernel` for each shape.
_KERNELS = {
    GAUSSIAN.name: _ELLIPSE,
    SKEW_NORMAL.name: "skewNormal",
    GENERALISED_EXPONENTIAL.name: "generalisedExponential",
}


def kernel_extension(shape: str) -> str:
    """Return the name of the kernel extension of a shape; an empty text for the ellipse."""
    return "" if _KERNELS[shape] == _ELLIPSE else f"CLSPLAT_gaussian_splatting_kernel_{shape.replace('-', '_')}"


def _attribute(shape: str) -> str:
    """Return the attribute of a kernel extension."""
    return f"{kernel_extension(shape)}:{EXTRA_FIELDS[shape].upper()}"


# ---- writing -------------------------------------------------------------------------------------------------------


def write_gltf_splats(path: str | os.PathLike[str], splats: StoredSplats) -> None:
    """Write splats of one of the shapes of `_KERNELS` as a .glb file.

    Raises
    ------
    InputError : the shape is not in `activated.EXTRA_FIELDS`, there is no splat, or the file would exceed 4 GiB.
    OutputError : the file cannot be written.
    """
    if splats.shape not in _KERNELS:
        raise InputError(f"{path}: .glb files hold {', '.join(_KERNELS)} splats, not {splats.shape}; convert them")
    if not len(splats.arrays["mean"]):
        raise InputError(f"{path}: the model has no splats, and glTF has no empty arrays: write a .ply")
    with named_place(str(path)):
        attributes = _attributes(splats)
    extension: Json = {
        "kernel": _KERNELS[splats.shape],
        "colorSpace": _SRGB,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    used, name = [EXTENSION], kernel_extension(splats.shape)
    if name:
        parameters = {"normalisation": splats.normalisation} if shape_named(splats.shape).normalised else {}
        extension["extensions"] = {name: parameters}
        used.append(name)
    primitive = {
        "mode": _POINTS,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: extension},
        "extras": {
            _EXTRAS: {
                "antialiased": splats.antialiased,
                "nearPlane": splats.near_plane,
                "lowPass": splats.low_pass,
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": f"clsplat {__version__}"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "splats"}],
        "meshes": [{"primitives": [primitive]}],
    }
    write_glb(path, document, attributes)


def _attributes(splats: StoredSplats) -> dict[str, NDArray[Any]]:
    """Return the attributes of the primitive, (N, width) each."""
    values = activated(splats, LUF)
    sh, opacity = values["sh"], values[OPACITY][:, None]
    color = np.clip(0.5 + SH_C0 * sh[:, 0], 0.0, 1.0)
    single = {
        "POSITION": values["mean"],
        f"{EXTENSION}:ROTATION": values["quat"][:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": values[SCALE],
        f"{EXTENSION}:OPACITY": opacity,
    }
    single |= {name: sh[:, place] for place, name in enumerate(_harmonics(sh.shape[1]))}
    if EXTRA_FIELDS[splats.shape]:
        single[_attribute(splats.shape)] = values[EXTRA_FIELDS[splats.shape]].reshape(len(sh), -1)
    attributes: dict[str, NDArray[Any]] = {name: array.astype("<f4") for name, array in single.items()}
    # For viewers that draw points, because they do not know the extension.
    attributes["COLOR_0"] = np.rint(255.0 * np.concatenate([color, opacity], axis=1)).astype(np.uint8)
    return attributes


def _harmonics(coefficients: int) -> Iterator[str]:
    """Yield the names of the attributes of the SH coefficients, in their order."""
    for degree in range(round(coefficients**0.5)):
        for place in range(2 * degree + 1):
            yield f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}"


# ---- reading -------------------------------------------------------------------------------------------------------


def read_gltf_splats(path: Path) -> StoredSplats:
    """Read the splats of a .glb or .gltf file: all primitives of its scene that have KHR_gaussian_splatting.

    Raises
    ------
    InputError : the file is missing or damaged, has no splats, or its splats are compressed or of several kernels.
    """
    file = read_gltf(path)
    required = file.json.get("extensionsRequired", [])
    known = {EXTENSION, _QUANTISED, *map(kernel_extension, _KERNELS)}
    unknown = [str(name) for name in required if name not in known] if isinstance(required, list) else ["?"]
    if unknown:
        raise InputError(f"{path}: needs the glTF extension {unknown[0][:80]}, which is not read; export it without")
    parts = [_primitive(file, primitive, matrix) for primitive, matrix in _primitives(file)]
    if not parts:
        raise InputError(f"{path}: has no splats ({EXTENSION}); choose a file of splats")
    return joined_parts(path, parts)


def _primitives(file: GltfFile) -> Iterator[tuple[Json, DoubleArray]]:
    """Yield the primitives with splats of the scene, each with the (4, 4) matrix of its node in the world."""
    for primitive, matrix in scene_primitives(file):
        extensions = primitive.get("extensions")
        if isinstance(extensions, dict) and EXTENSION in extensions:
            yield primitive, matrix


def _primitive(file: GltfFile, primitive: Json, matrix: DoubleArray) -> StoredSplats:
    """Return the splats of a primitive in float64, with the axes of a PLY."""
    extension = primitive["extensions"][EXTENSION]
    attributes = primitive.get("attributes")
    if not isinstance(extension, dict) or not isinstance(attributes, dict):
        raise file.fault(f"a primitive with {EXTENSION} has no attributes")
    shape, parameters = _kernel(file, extension)
    count = len(file.array(attributes.get("POSITION")))

    def values(name: str, width: int) -> Array:
        found = file.array(attributes[name]) if name in attributes else None
        if found is None or found.shape != (count, width):
            raise file.fault(f"{name} is missing, or not {width} numbers for each of {count} splats")
        return found

    scale = values(f"{EXTENSION}:SCALE", 3)
    if (scale < 0.0).any():
        raise file.fault(f"{EXTENSION}:SCALE is below 0 (drafts of the extension had logarithms)")
    found = {
        "mean": values("POSITION", 3),
        "quat": values(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        SCALE: scale,
        OPACITY: values(f"{EXTENSION}:OPACITY", 1)[:, 0],
        "sh": np.stack([values(name, 3) for name in _harmonics(_coefficients(attributes))], axis=1),
    }
    for field in shape.fields:
        found[field.name] = values(_attribute(shape.name), field.width).reshape(public_shape(field, count))
    arrays = raw_arrays(shape.name, found, LUF)
    antialiased, *numbers = _extras(file, primitive)
    splats = StoredSplats(shape.name, _normalisation(file, parameters), antialiased, arrays, *numbers)
    return placed(file.path, splats, matrix, LUF)


def _kernel(file: GltfFile, extension: Json) -> tuple[Shape, Json]:
    """Return the kernel of a primitive and the parameters of its extension."""
    inner = extension.get("extensions", {})
    if not isinstance(inner, dict):
        raise file.fault(f"the extensions of {EXTENSION} are not an object")
    for name in inner:
        if "compression" in name:
            raise InputError(f"{file.path}: its splats are compressed ({name[:80]}): export it without")
    if extension.get("colorSpace") == _LINEAR:
        warnings.warn(f"{file.path}: has linear colours, which are shown too dark", stacklevel=4)
    for shape in _KERNELS:
        parameters = inner.get(kernel_extension(shape))
        if isinstance(parameters, dict):
            return shape_named(shape), parameters
    if extension.get("kernel", _ELLIPSE) != _ELLIPSE:
        kind = str(extension["kernel"])[:40]
        warnings.warn(f"{file.path}: kernel {kind!r} is unknown; its splats are read as Gaussians", stacklevel=4)
    return GAUSSIAN, {}


def _normalisation(file: GltfFile, parameters: Json) -> str:
    found = parameters.get("normalisation", NORMALISATIONS[0])
    if found not in NORMALISATIONS:
        raise file.fault(f"normalisation {str(found)[:40]!r} is not one of {', '.join(NORMALISATIONS)}")
    return str(found)


def _extras(file: GltfFile, primitive: Json) -> tuple[bool, float, float]:
    """Return whether the splats are antialiased, the near plane and the low pass."""
    extras = primitive.get("extras")
    extra = extras.get(_EXTRAS) if isinstance(extras, dict) else None
    found = extra if isinstance(extra, dict) else {}
    numbers = []
    for name, number in (("nearPlane", NEAR_PLANES), ("lowPass", LOW_PASSES)):
        value = found.get(name, number.usual)
        if not number.accepts(value):
            raise file.fault(f"extras.{_EXTRAS}.{name} is {str(value)[:40]!r}")
        numbers.append(number.usable(value))
    return found.get("antialiased") is True, numbers[0], numbers[1]


def _coefficients(attributes: Json) -> int:
    """Return the number of SH coefficients of the highest degree that has its first attribute."""
    degree = max(
        (degree for degree in range(MAX_SH_DEGREE + 1) if f"{EXTENSION}:SH_DEGREE_{degree}_COEF_0" in attributes),
        default=0,
    )
    return sh_coefficients(degree)
