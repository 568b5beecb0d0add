"""Splats in OpenUSD files (splats/formats/usd.py): what the library finds, what comes back, named faults."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from same_splats import model, same

from clsplat.errors import InputError, OutputError
from clsplat.splats.axes import RUB, flipped
from clsplat.splats.formats import usd
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined, transformed

pxr = pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol  # noqa: E402


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.usda"


@pytest.mark.parametrize("ending", usd.USD_ENDINGS)
@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "generalised-exponential"])
def test_the_model_comes_back(tmp_path: Path, shape: str, ending: str) -> None:
    before = model(shape, 3, antialiased=True, near_plane=0.07, low_pass=0.1)
    before.save(tmp_path / f"model{ending}")
    same(Splats.load(tmp_path / f"model{ending}"), before)
    assert [path.name for path in tmp_path.iterdir()] == [f"model{ending}"]


@pytest.mark.parametrize("degree", range(3))
def test_fewer_bands_and_other_normalisations(file: Path, degree: int) -> None:
    before = model(degree=degree, normalisation="pdf")
    before.save(file)
    same(Splats.load(file), before)


def test_the_library_finds_the_schema(file: Path) -> None:
    splats = model()
    splats.save(file)
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    prim = stage.GetDefaultPrim()
    found = UsdVol.ParticleField3DGaussianSplat(prim)
    assert found
    wanted = flipped(splats.arrays, RUB)
    position, orientation, scale, opacity, radiance = (
        getattr(UsdVol, f"ParticleField{name}AttributeAPI")(prim)
        for name in ("Position", "Orientation", "Scale", "Opacity", "SphericalHarmonics")
    )
    np.testing.assert_array_equal(position.GetPositionsAttr().Get(), wanted["mean"])
    np.testing.assert_allclose(scale.GetScalesAttr().Get(), np.exp(wanted["log_scale"]), rtol=1e-6)
    stored = np.array([[q.real, *q.imaginary] for q in orientation.GetOrientationsAttr().Get()])
    unit = wanted["quat"] / np.linalg.norm(wanted["quat"], axis=1, keepdims=True)
    np.testing.assert_allclose(stored, unit, atol=1e-6)
    np.testing.assert_allclose(opacity.GetOpacitiesAttr().Get(), 1 / (1 + np.exp(-wanted["opacity_logit"])), atol=1e-6)
    assert radiance.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    coefficients = np.array(radiance.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_array_equal(coefficients.reshape(-1, 9, 3), wanted["sh"])
    low, high = np.array(found.GetExtentAttr().Get())
    reach = 3 * np.exp(wanted["log_scale"].max(axis=1))[:, None]
    np.testing.assert_allclose(low, (wanted["mean"] - reach).min(axis=0), rtol=1e-5)
    np.testing.assert_allclose(high, (wanted["mean"] + reach).max(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(prim.GetAttribute("clsplat:skew").Get(), wanted["skew"])


@pytest.mark.parametrize("ending", usd.USD_ENDINGS)
def test_the_librarys_validators_find_nothing(tmp_path: Path, ending: str) -> None:
    validation = pytest.importorskip("pxr.UsdValidation")
    file = tmp_path / f"model{ending}"
    model().save(file)
    registry = validation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = validation.ValidationContext(validators).Validate(Usd.Stage.Open(str(file)))
    assert [error.GetErrorAsString() for error in errors] == []


def test_half_precision_and_missing_extras(file: Path) -> None:
    splats = model("gaussian")
    splats.save(file)
    stage = Usd.Stage.Open(str(file))
    prim = stage.GetDefaultPrim()
    for attribute in prim.GetAttributes():
        if attribute.GetName().startswith("clsplat:"):
            prim.RemoveProperty(attribute.GetName())
    harmonics = "radiance:sphericalHarmonicsCoefficients"
    for name, kind in (
        ("positions", Sdf.ValueTypeNames.Point3hArray),
        ("orientations", Sdf.ValueTypeNames.QuathArray),
        ("scales", Sdf.ValueTypeNames.Half3Array),
        ("opacities", Sdf.ValueTypeNames.HalfArray),
        (harmonics, Sdf.ValueTypeNames.Half3Array),
    ):
        values = prim.GetAttribute(name).Get()
        prim.RemoveProperty(name)
        halves = [Gf.Quath(q) for q in values] if name == "orientations" else values
        prim.CreateAttribute(f"{name}h", kind, False).Set(
            halves if name in ("orientations", "opacities") else [Gf.Vec3h(*v) for v in values]
        )
    stage.Save()
    same(Splats.load(file), splats, 6e-3)


def test_the_place_and_the_up_axis_of_the_stage(file: Path) -> None:
    splats = model(near_plane=0.1)
    splats.save(file)
    stage = Usd.Stage.Open(str(file))
    matrix = 2.0 * np.eye(4)
    matrix[:3, :3] = matrix[:3, :3] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    matrix[:, 3] = 1, 2, 3, 1
    UsdGeom.Xformable(stage.GetDefaultPrim()).AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))
    stage.Save()
    flips = np.diag([*RUB, 1])
    same(Splats.load(file), transformed(splats, flips @ matrix @ flips), 2e-5)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.Save()
    up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z becomes y
    same(Splats.load(file), transformed(splats, flips @ up @ matrix @ flips), 2e-5)


def test_several_prims_are_one_model(file: Path) -> None:
    splats = model()
    splats.save(file)
    stage = Usd.Stage.Open(str(file))
    other = stage.DefinePrim("/other", "ParticleField3DGaussianSplat")
    other.GetReferences().AddInternalReference(stage.GetDefaultPrim().GetPath())
    stage.Save()
    same(Splats.load(file), joined([splats, splats]))
    other.GetAttribute("clsplat:shape").Set("gaussian")
    stage.Save()
    with pytest.raises(InputError, match="has splats of several kernels"):
        Splats.load(file)


FAULTS = {
    "clsplat:shape": ("cube", "kernel 'cube, peak' is unknown"),
    "clsplat:normalisation": ("sum", "kernel 'skew-normal, sum' is unknown"),
    "clsplat:nearPlane": (-1.0, "nearPlane is -1.0, give a depth above 0"),
    "clsplat:lowPass": (0.0, "lowPass is 0.0, give a variance above 0"),
    "clsplat:skew": ([Gf.Vec3f(1)], "clsplat:skew is missing, or not 3 numbers for each of 30"),
    "radiance:sphericalHarmonicsDegree": (7, "has SH degree 7, expected 0 to 3"),
    "radiance:sphericalHarmonicsCoefficients": ([Gf.Vec3f(1)], "is missing, or not 27 numbers"),
    "scales": ([], "scales is missing, or not 3 numbers"),
    "opacities": ([0.5], "opacities is missing, or not 1 numbers"),
    "orientations": ([Gf.Quatf(1)], "orientations is missing, or not 4 numbers"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(file: Path, name: str) -> None:
    value, message = FAULTS[name]
    model().save(file)
    stage = Usd.Stage.Open(str(file))
    stage.GetDefaultPrim().GetAttribute(name).Set(value)
    stage.Save()
    with pytest.raises(InputError, match=message) as caught:
        Splats.load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["model.usda", "model.usdc", "model.usd", "model.usdz"])
def test_other_files_and_missing_files(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        Splats.load(tmp_path / name)
    (tmp_path / name).write_bytes(b"hello, this is a text")
    with pytest.raises(InputError, match="is not a sound USD file") as caught:
        Splats.load(tmp_path / name)
    assert "\n" not in str(caught.value)
    Usd.Stage.CreateNew(str(tmp_path / "empty.usda")).Save()
    with pytest.raises(InputError, match="has no splats"):
        Splats.load(tmp_path / "empty.usda")


def test_equal_models_give_equal_archives(tmp_path: Path) -> None:
    """The members of a .usdz have no times."""
    written = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        model().save(tmp_path / name / "model.usdz")
        written.append((tmp_path / name / "model.usdz").read_bytes())
    with zipfile.ZipFile(tmp_path / "a" / "model.usdz") as archive:
        assert archive.testzip() is None
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert written[0] == written[1]


@pytest.mark.parametrize("name", ["a\nb.usdz", "a\tb.usdz", "a:SDF_FORMAT_ARGS:b.usda", "a:SDF_FORMAT_ARGS:b.usdz"])
def test_names_that_the_library_does_not_take(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="usd-core takes no such name: choose another name"):
        model().save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".usdc", ".glb"])
def test_scales_that_float32_does_not_hold_are_named(tmp_path: Path, ending: str) -> None:
    splats = model()
    arrays = splats.to_numpy()
    arrays["log_scale"][2, 1] = 1e9
    with pytest.raises(InputError, match=rf"model\{ending}: splat 2 has the scale e\^1e\+09"):
        splats.with_arrays(arrays).save(tmp_path / f"model{ending}")


def test_what_usd_files_do_not_hold_and_where_they_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="USD files hold gaussian, skew-normal, generalised-exponential splats"):
        model("student-t").save(tmp_path / "model.usdc")
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError):
        model().save(tmp_path / "file" / "model.usdc")


def test_without_the_library_one_line_says_what_to_install(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    for action in (lambda: model().save(file), lambda: Splats.load(file)):
        with pytest.raises(InputError, match=r'USD files need usd-core: pip install "clsplat\[usd\]"'):
            action()
