"""Splats in OpenUSD files, as the schema ParticleField3DGaussianSplat of OpenUSD 26.03 and later. Needs usd-core.

Schema: https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html. A particle has a
position, a unit quaternion, standard deviations, an opacity 0..1 and SH coefficients. The axes are x right, y up, z
back.

The kernels of the schema are Gaussians. Attributes in the namespace `clsplat` hold what they lack: the shape with its
normalisation, its field (`clsplat:skew` or `clsplat:beta`), `clsplat:antialiased`, `clsplat:nearPlane` and
`clsplat:lowPass`. Other programs show a skew-normal as the Gaussian with its mean, its covariance and its peak.
"""

from __future__ import annotations

import io
import json
import os
import re
import struct
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, OutputError, named_place
from ...files.atomic import atomic_path
from ...files.file_names import printable
from ...files.host_memory import limit_address_space
from ..activated import EXTRA_FIELDS, OPACITY, SCALE, activated, placed, raw_arrays
from ..axes import RUB
from ..fields import MAX_SH_DEGREE, DoubleArray, sh_coefficients, sh_degree_of
from ..low_pass import LOW_PASSES
from ..model_number import ModelNumber
from ..near_plane import NEAR_PLANES
from ..shapes import GAUSSIAN, NORMALISATIONS, shape_named
from ..stored import StoredSplats, joined_parts

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
_MAGICS = (b"#usda", b"PXR-USDC")
_TYPE = "ParticleField3DGaussianSplat"
_PRIM = "/splats"
_REFUSED = 3  # exit code of the reading process if it refuses the file
_MEMORY, _MEMORY_OF_BYTE = 3 << 30, 40  # of that process, so that a false size in a file cannot take all memory
# Each thread reserves address space, which the limit counts.
_FEW_THREADS = {"PXR_WORK_THREAD_LIMIT": "1", "MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
_ARGUMENTS = ":SDF_FORMAT_ARGS:"  # begins the arguments of a layer in its name
_CONTROL = re.compile(r"[\x00-\x1f]")  # not in names of an archive's members
# Zip archives: place of the time and date in the header of a member, and in its entry of the directory. Length of an
# entry without its texts. Place of the lengths of these texts.
_LOCAL_TIME, _ENTRY_TIME, _ENTRY, _LENGTHS = 10, 12, 46, 28
_FIRST_DAY = struct.pack("<HH", 0, 1 << 5 | 1)  # midnight of 1980-01-01, the first that zip archives know
_SUPPORT = 3.0  # standard deviations: the extent of a splat in bounding boxes
_HARMONICS = "radiance:sphericalHarmonicsCoefficients"
_DEGREE = "radiance:sphericalHarmonicsDegree"
_NAMES = {"mean": "positions", "quat": "orientations", SCALE: "scales", OPACITY: "opacities", "sh": _HARMONICS}
_SHAPE, _NORMALISATION, _ANTIALIASED, _NEAR_PLANE, _LOW_PASS = (
    f"clsplat:{name}" for name in ("shape", "normalisation", "antialiased", "nearPlane", "lowPass")
)


def is_usd(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is an OpenUSD file, but not .usdz."""
    return start.startswith(_MAGICS)


def write_usd(path: str | os.PathLike[str], splats: StoredSplats) -> None:
    """Write splats as a .usda, .usdc, .usd or .usdz file. The ending decides.

    Raises
    ------
    InputError : the shape is not in `activated.EXTRA_FIELDS`, or usd-core is missing.
    OutputError : the file cannot be written.
    """
    if splats.shape not in EXTRA_FIELDS:
        raise InputError(f"{path}: USD files hold {', '.join(EXTRA_FIELDS)} splats, not {splats.shape}; convert them")
    _check_library(path)
    from pxr import Sdf, Tf, Usd, UsdUtils

    whole = os.fspath(path)
    if printable(whole) != whole:
        raise OutputError(f"{printable(whole)}: usd-core takes names in UTF-8 only: choose another name")
    if _ARGUMENTS in whole or (whole.lower().endswith(USD_ENDINGS[-1]) and _CONTROL.search(Path(path).name)):
        raise OutputError(f"{path}: usd-core takes no such name: choose another name")
    try:
        with atomic_path(path) as temporary:
            packed = temporary.suffix.lower() == USD_ENDINGS[-1]
            layer = temporary.with_suffix(".usdc") if packed else temporary
            try:
                stage = Usd.Stage.CreateNew(str(layer))
                with named_place(str(path)):
                    _define(stage, splats)
                stage.GetRootLayer().Save()
                if packed:
                    name = Path(path).with_suffix(".usdc").name  # of the layer in the archive
                    UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(temporary), name)
                    _without_times(temporary)
            finally:
                if packed:
                    layer.unlink(missing_ok=True)
    except Tf.ErrorException as error:
        raise OutputError(f"{path}: cannot be written ({_reason(error)}); check place, rights and free space") from None


def _without_times(archive: Path) -> None:
    """Set the times of all members of a zip archive to 1980-01-01, so that equal models give equal bytes."""
    with zipfile.ZipFile(archive) as opened:
        members, start = opened.infolist(), opened.start_dir
    with archive.open("r+b") as stream:
        place = start
        for member in members:
            stream.seek(place)
            lengths = struct.unpack_from("<HHH", stream.read(_ENTRY), _LENGTHS)
            for at in (member.header_offset + _LOCAL_TIME, place + _ENTRY_TIME):
                stream.seek(at)
                stream.write(_FIRST_DAY)
            place += _ENTRY + sum(lengths)


def _define(stage: Any, splats: StoredSplats) -> None:
    """Define the splats on an empty stage."""
    from pxr import Gf, Sdf, UsdGeom, Vt

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim(_PRIM, _TYPE)
    stage.SetDefaultPrim(prim)
    values = activated(splats, RUB)

    def put(name: str, kind: Any, value: Any, custom: bool = False) -> Any:
        attribute = prim.CreateAttribute(name, kind, custom, Sdf.VariabilityVarying if not custom else _uniform())
        attribute.Set(value)
        return attribute

    kinds = Sdf.ValueTypeNames
    mean, scale = values["mean"].astype(np.float32), values[SCALE].astype(np.float32)
    put(_NAMES["mean"], kinds.Point3fArray, Vt.Vec3fArray.FromNumpy(mean))
    # Vt's memory has the scalar of a quaternion last.
    quat = np.ascontiguousarray(values["quat"][:, [1, 2, 3, 0]], np.float32)
    put(_NAMES["quat"], kinds.QuatfArray, Vt.QuatfArray.FromNumpy(quat))
    put(_NAMES[SCALE], kinds.Float3Array, Vt.Vec3fArray.FromNumpy(scale))
    put(_NAMES[OPACITY], kinds.FloatArray, Vt.FloatArray.FromNumpy(values[OPACITY].astype(np.float32)))
    sh = np.ascontiguousarray(values["sh"].reshape(-1, 3), np.float32)
    put(_HARMONICS, kinds.Float3Array, Vt.Vec3fArray.FromNumpy(sh)).SetMetadata("elementSize", values["sh"].shape[1])
    put(_DEGREE, kinds.Int, sh_degree_of(values["sh"].shape[1]))
    put("projectionModeHint", kinds.Token, "perspective")
    put("sortingModeHint", kinds.Token, "zDepth")
    if len(mean):
        reach = _SUPPORT * scale.max(axis=1, keepdims=True)
        corners = (mean - reach).min(axis=0), (mean + reach).max(axis=0)
        put("extent", kinds.Float3Array, [Gf.Vec3f(*corner.tolist()) for corner in corners])
    put(_SHAPE, kinds.Token, splats.shape, True)
    put(_NORMALISATION, kinds.Token, splats.normalisation, True)
    put(_ANTIALIASED, kinds.Bool, splats.antialiased, True)
    put(_NEAR_PLANE, kinds.Double, splats.near_plane, True)
    put(_LOW_PASS, kinds.Double, splats.low_pass, True)
    extra = EXTRA_FIELDS[splats.shape]
    if extra:
        array = values[extra].astype(np.float32)
        if array.ndim == 2:
            put(f"clsplat:{extra}", kinds.Float3Array, Vt.Vec3fArray.FromNumpy(array), True)
        else:
            put(f"clsplat:{extra}", kinds.FloatArray, Vt.FloatArray.FromNumpy(array), True)


def _uniform() -> Any:
    from pxr import Sdf

    return Sdf.VariabilityUniform


def read_usd(path: Path) -> StoredSplats:
    """Read the splats of an OpenUSD file: all ParticleField3DGaussianSplat that its stage shows.

    The library reads the file in a process of its own, because damaged files can end it or take all memory.

    Raises
    ------
    InputError : the file is missing or damaged, or has no splats or splats of several kernels; or usd-core is missing.
    """
    _check_library(path)
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check name and rights") from None
    command = [sys.executable, "-c", f"from {__name__} import answer; answer()", str(path)]
    folder = Path(__file__).resolve().parents[2]
    paths = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths} | _FEW_THREADS
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    if done.returncode == _REFUSED:
        raise InputError(f"{path}: {done.stdout.decode()}")
    if done.returncode:
        raise InputError(f"{path}: is not a sound USD file (it ends the library that reads it); export it again")
    return joined_parts(path, _unpacked(done.stdout))


def answer() -> None:
    """Read the USD file that the command line names, and write its parts to standard output, or why it is refused."""
    limit_address_space(_MEMORY + _MEMORY_OF_BYTE * os.path.getsize(sys.argv[1]))
    try:
        data = _packed(_parts(sys.argv[1]))
    except InputError as error:
        sys.stdout.write(str(error))
        sys.exit(_REFUSED)
    sys.stdout.buffer.write(data)


def _packed(parts: list[StoredSplats]) -> bytes:
    """Return parts as bytes."""
    stream = io.BytesIO()
    kinds = [[part.shape, part.normalisation, part.antialiased, part.near_plane, part.low_pass] for part in parts]
    arrays = {f"{index}.{name}": array for index, part in enumerate(parts) for name, array in part.arrays.items()}
    np.savez(stream, allow_pickle=False, kinds=np.array(json.dumps(kinds)), **arrays)
    return stream.getvalue()


def _unpacked(data: bytes) -> list[StoredSplats]:
    """Return the parts that `_packed` has packed."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        found: list[StoredSplats] = []
        for index, (shape, normalisation, antialiased, *numbers) in enumerate(json.loads(str(stored["kinds"]))):
            start = f"{index}."
            arrays = {name.removeprefix(start): stored[name] for name in stored.files if name.startswith(start)}
            found.append(StoredSplats(shape, normalisation, antialiased, arrays, *numbers))
    return found


def _parts(name: str) -> list[StoredSplats]:
    """Return the splats of each prim. Raises InputError with a message that does not name the file."""
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(name)
        parts = [_part(prim, UsdGeom.XformCache(), _to_y_up(stage)) for prim in _prims(stage)]
    except (Tf.ErrorException, UnicodeDecodeError) as error:  # the second: a damaged name
        raise InputError(f"is not a sound USD file ({_reason(error)}); export it again") from None
    if not parts:
        raise InputError(f"has no splats ({_TYPE}); choose a file of splats")
    return parts


def _prims(stage: Any) -> Iterator[Any]:
    for prim in stage.Traverse():
        if prim.GetTypeName() == _TYPE:
            yield prim


def _to_y_up(stage: Any) -> DoubleArray:
    """Return the rotation (4, 4) from the stage's axes to those with y up."""
    from pxr import UsdGeom

    matrix = np.eye(4)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        matrix[1:3, 1:3] = [[0.0, 1.0], [-1.0, 0.0]]
    return matrix


def _part(prim: Any, transforms: Any, upright: DoubleArray) -> StoredSplats:
    """Return the splats of a prim in float64, with the axes of a PLY."""
    shape = _attribute(prim, _SHAPE) or GAUSSIAN.name
    normalisation = _attribute(prim, _NORMALISATION) or NORMALISATIONS[0]
    kind = f"{shape}, {normalisation}"
    if not (isinstance(shape, str) and shape in EXTRA_FIELDS and normalisation in NORMALISATIONS):
        raise InputError(f"{prim.GetPath()}: kernel {kind[:60]!r} is unknown; export it again")
    numbers = [_number(prim, _NEAR_PLANE, NEAR_PLANES), _number(prim, _LOW_PASS, LOW_PASSES)]
    count = len(_attribute(prim, _NAMES["mean"]) or _attribute(prim, _NAMES["mean"] + "h") or ())
    degree = _attribute(prim, _DEGREE)
    degree = MAX_SH_DEGREE if degree is None else degree
    if type(degree) is not int or not 0 <= degree <= MAX_SH_DEGREE:
        raise InputError(f"{prim.GetPath()}: has SH degree {str(degree)[:20]}, expected 0 to {MAX_SH_DEGREE}")
    coefficients = sh_coefficients(degree)

    def values(name: str, width: int, each: int = 1) -> DoubleArray:
        found = _attribute(prim, name)
        found = _attribute(prim, name + "h") if found is None else found  # in half precision
        array = np.asarray(() if found is None else found, np.float64)
        if array.shape not in ((count * each, width), (count * each,)[: 1 if width == 1 else 0]):
            raise InputError(
                f"{prim.GetPath()}: {name} is missing, or not {each * width} numbers for each of {count} "
                "splats; export it again"
            )
        return array

    found = {
        "mean": values(_NAMES["mean"], 3),
        "quat": values(_NAMES["quat"], 4)[:, [3, 0, 1, 2]],
        SCALE: values(_NAMES[SCALE], 3),
        OPACITY: values(_NAMES[OPACITY], 1),
        "sh": values(_HARMONICS, 3, coefficients).reshape(count, coefficients, 3),
    }
    if EXTRA_FIELDS[shape]:
        (field,) = shape_named(shape).fields
        found[field.name] = values(f"clsplat:{field.name}", field.width)
    splats = StoredSplats(
        shape,
        normalisation,
        _attribute(prim, _ANTIALIASED) is True,
        raw_arrays(shape, found, RUB),
        *numbers,
    )
    # USD's matrices are for rows.
    world = upright @ np.array(transforms.GetLocalToWorldTransform(prim)).T
    return placed(prim.GetPath(), splats, world, RUB)


def _number(prim: Any, name: str, number: ModelNumber) -> float:
    """Return a number of the model, or its usual value. Raises InputError if it is unusable."""
    found = _attribute(prim, name)
    if found is not None and not number.accepts(found):
        raise InputError(f"{prim.GetPath()}: {name} is {str(found)[:20]}, give {number.what}")
    return number.usual if found is None else number.usable(found)


def _attribute(prim: Any, name: str) -> Any:
    """Return the value of an attribute; None if it has no value."""
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def _check_library(path: object) -> None:
    if find_spec("pxr") is None:
        raise InputError(f'{path}: USD files need usd-core: pip install "clsplat[usd]"')


def _reason(error: Exception) -> str:
    """Return what an error of the library says, without its place in the source."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # the message quotes damaged text
        return "damaged text"
    messages = re.findall(r" : '(.*)'", text)
    return (messages[0] if messages else text.strip().partition("\n")[0])[:160]
