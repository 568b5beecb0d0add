"""A shape that the package does not know: one kernel file and one descriptor make it complete.

The shape is alpha = opacity exp(-q/2) / (1 + pinch^2 q) with one parameter of its own, `pinch`; 0 is the Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.comparison.compare import compare
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.sweep import read_runs
from clsplat.comparison.sweep_charts import size_chart
from clsplat.comparison.sweep_rows import point_rows
from clsplat.device.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.evaluation.chart_style import INK, looks, shape_colour, shape_marker
from clsplat.models.convert import convert_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats import approximate
from clsplat.splats.approximate import nearest_gaussians, nearest_of_shape
from clsplat.splats.convert import convert
from clsplat.splats.fields import Array, Field
from clsplat.splats.shapes import BISECTED_SKEW, GAUSSIAN, OPACITY_MINUS, SHAPES, SLANT, Shape, register_shape
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

KERNEL = """
enum { P_FORM, P_OPACITY = P_FORM + 3, P_SQUARE, P_REACH, P_COUNT };  // P_FORM: q; P_SQUARE: pinch^2
// w = alpha v_alpha; g = w (1/2 + pinch^2 / (1 + pinch^2 q)): sums of w; g dx, ... g dy^2; w q / (1 + pinch^2 q)
enum { V_W, V_MOMENTS, V_PINCH = V_MOMENTS + 5, V_COUNT };

typedef struct {
    vreal alpha, q, inverse;
} shape_pixel;

static inline vreal shape_alpha(vreal dx, vreal dy, const real *p, shape_pixel *s) {
    s->q = max(quadratic_form(dx, dy, p + P_FORM), (vreal)0);
    s->inverse = (vreal)1 / lanes_mad(s->q, (vreal)(p[P_SQUARE]), (vreal)1);
    s->alpha = p[P_OPACITY] * lanes_exp(R(-0.5) * s->q) * s->inverse;
    return s->alpha;
}

static inline vmask shape_reaches(vreal dx, vreal dy, const real *p) {
    return quadratic_form(dx, dy, p + P_FORM) <= (vreal)p[P_REACH];
}

static inline void shape_alpha_vjp(vreal dx, vreal dy, const real *p, shape_pixel s, vreal v_alpha, vreal *v) {
    const vreal w = v_alpha * s.alpha;
    v[V_W] += w;
    add_moments(w * (R(0.5) + p[P_SQUARE] * s.inverse), dx, dy, v + V_MOMENTS);
    v[V_PINCH] += w * s.q * s.inverse;
}

static inline void shape_project(splat_params s, vec3 b0, vec3 b1, sym2 cov2d, vreal *p, extents *box) {
    const sym2 conic = conic_of(b0, b1, cov2d);
    set_quadratic_form(conic, (vreal)1, p + P_FORM);
    p[P_OPACITY] = s.opacity;
    p[P_SQUARE] = s.raw[RAW_PINCH] * s.raw[RAW_PINCH];
    const vreal r = extent_radius(s.opacity);  // of the Gaussian, which is nowhere lower
    p[P_REACH] = block_reach(r, conic, spread_of(b0, b1, cov2d));
    box->right = box->left = r * sqrt(cov2d.xx);
    box->down = box->up = r * sqrt(cov2d.yy);
}

static inline void shape_project_vjp(splat_params s, vec3 b0, vec3 b1, sym2 cov2d, const vreal *v, shape_grads *g) {
    const sym2 conic = conic_of(b0, b1, cov2d);
    const vreal *m = v + V_MOMENTS;
    no_grads(g);
    g->s.opacity = v[V_W] / max(s.opacity, (vreal)R(1e-12));
    g->s.raw[RAW_PINCH] = R(-2.0) * s.raw[RAW_PINCH] * v[V_PINCH];
    g->mean_x = (real)2 * (conic.xx * m[0] + conic.xy * m[1]);
    g->mean_y = (real)2 * (conic.xy * m[0] + conic.yy * m[1]);
    g->cov2d = conic_of_vjp(b0, b1, cov2d, (sym2){-m[2], (real)-2 * m[3], -m[4]});
}
"""
SMOOTH = {"alpha_min": 0.0, "alpha_max": 1.0, "t_min": 0.0}


def profile(z: Array, fields: dict[str, Array]) -> Array:
    pinch = fields["pinch"].astype(np.float64)[:, None]
    return (np.exp(-0.5 * z * z) / (1.0 + pinch * pinch * z * z))[:, None]


PINCH = Field("pinch", 1, ("pinch",), (0.0,), lr=2e-2, lr_power=0.5, start=0.3)
PINCHED = Shape("pinched", "pinched.clh", (PINCH,), record=6, moments=7, profile=profile, flops=(30, 30))


@pytest.fixture(scope="module")
def shape(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The registered shape's name."""
    folder = tmp_path_factory.mktemp("shape")
    (folder / "pinched.clh").write_text(KERNEL)
    yield register_shape(PINCHED, sources=folder).name
    del SHAPES["pinched"]


def arrays(n: int = 12) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    return {
        "mean": rng.uniform(-0.8, 0.8, (n, 3)),
        "quat": rng.normal(size=(n, 4)),
        "log_scale": rng.uniform(-2.5, -1.0, (n, 3)),
        "opacity_logit": rng.uniform(-1.0, 3.0, n),
        "sh": rng.uniform(0.0, 1.0, (n, 1, 3)),
        "pinch": rng.uniform(-2.0, 2.0, n),
    }


def camera() -> Camera:
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera(40, 30, 44.0, 42.0, 19.0, 15.5, pose)


def reference(values: dict[str, np.ndarray], view: Camera) -> np.ndarray:
    """(H, W, 3) on black: the formula once more, splat by splat, in NumPy."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    color, transmittance = np.zeros((view.height, view.width, 3)), np.ones((view.height, view.width))
    points = values["mean"] @ view.rotation.T + view.translation
    for i in np.argsort(points[:, 2]):
        px, py, depth = points[i]
        rotation = Rotation.from_quat(values["quat"][i], scalar_first=True).as_matrix()
        root = rotation * np.exp(values["log_scale"][i])
        jacobian = np.array([[view.fx, 0, -view.fx * px / depth], [0, view.fy, -view.fy * py / depth]]) / depth
        b = jacobian @ view.rotation @ root
        d = np.stack([x - view.fx * px / depth - view.cx, y - view.fy * py / depth - view.cy], axis=-1)
        q = np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(b @ b.T + 0.3 * np.eye(2)), d)
        opacity = 1.0 / (1.0 + np.exp(-values["opacity_logit"][i]))
        alpha = opacity * np.exp(-0.5 * q) / (1.0 + values["pinch"][i] ** 2 * q)
        rgb = np.maximum(0.5 + 0.28209479177387814 * values["sh"][i, 0], 0.0)
        color += (transmittance * alpha)[..., None] * rgb
        transmittance *= 1.0 - alpha
    return color


def test_it_renders_as_its_formula_says(shape: str, device: Device) -> None:
    splats = Splats(shape, {name: value.astype(np.float32) for name, value in arrays().items()})
    got = Renderer(device, "float64", **SMOOTH).render(splats, camera()).color
    want = reference({name: value.astype(np.float64) for name, value in splats.to_numpy().items()}, camera())
    np.testing.assert_allclose(got, want, atol=1e-9)
    # The default thresholds leave out what 8 bits cannot show, and boxes and blocks nothing else.
    assert np.abs(Renderer(device).render(splats, camera()).color - want).max() < len(splats) / 255


def test_its_gradient_is_that_of_its_image(shape: str, device: Device) -> None:
    renderer, values = Renderer(device, "float64", **SMOOTH), arrays()
    rng = np.random.default_rng(5)
    v_color = rng.normal(size=(30, 40, 3))
    direction = {name: rng.normal(size=value.shape) for name, value in values.items()}
    ends = [
        (v_color * reference({n: value + step * direction[n] for n, value in values.items()}, camera())).sum()
        for step in (1e-5, -1e-5)
    ]
    renderer.render(Splats(shape, values), camera())
    grads = renderer.backward(v_color)
    assert grads["pinch"].all()
    along = sum(float((grads[name] * direction[name]).sum()) for name in grads)
    assert along == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_it_trains_and_survives_a_file(shape: str, scene: Scene, tmp_path: Path, strategy: str) -> None:
    config = TrainConfig(shape=shape, strategy=strategy, iterations=30, cap_max=80, sh_degree=1, densify_interval=5)
    splats = train(scene, config).splats
    pinch = splats.to_numpy()["pinch"]
    assert np.isfinite(pinch).all()
    assert len(np.unique(pinch)) > 10, "its parameter learns, at the rate of its field"
    splats.save(tmp_path / "model.ply")
    loaded = Splats.load(tmp_path / "model.ply")
    assert loaded.shape == shape
    for name, value in splats.to_numpy().items():
        np.testing.assert_array_equal(loaded.to_numpy()[name], value)


def test_it_is_compared_and_drawn(shape: str, scene: Scene, tmp_path: Path) -> None:
    options = {"iterations": 10, "sh_degree": 0}
    compare([scene], parse_methods(f"gaussian,{shape}"), tmp_path, [40, 60], [0], options)
    lines = [line for line in (tmp_path / "table.md").read_text().splitlines() if f"| {shape} |" in line]
    assert len(lines) == 2
    rows = point_rows(read_runs(tmp_path))
    assert {row["shape"] for row in rows} == {"gaussian", shape}
    assert all(path.stat().st_size for path in size_chart(rows, tmp_path / "sizes"))
    assert shape_colour(shape) not in {INK, *(shape_colour(name) for name in SHAPES if name != shape)}
    assert looks({shape: shape})[shape]["marker"] == shape_marker(shape)


def test_registration_names_what_is_wrong(shape: str, tmp_path: Path, device: Device) -> None:
    with pytest.raises(InputError, match="'pinched': this name is taken"):
        register_shape(PINCHED, sources=tmp_path)
    with pytest.raises(InputError, match=r"other\.clh: no such kernel file"):
        register_shape(Shape("other", "other.clh", (), 5, 6, GAUSSIAN.profile, (1, 1)), sources=tmp_path)
    clash = Field("mean", 1, ("pinch",), (0.0,), 1e-3)
    with pytest.raises(InputError, match="another shape has a field 'mean'"):
        register_shape(Shape("other", "other.clh", (clash,), 5, 6, GAUSSIAN.profile, (1, 1)))
    (tmp_path / "other.clh").write_text(KERNEL)
    register_shape(Shape("other", "other.clh", (PINCH,), 7, 7, profile, (30, 30)), sources=tmp_path)
    try:
        with pytest.raises(DeviceError, match="record_has_SHAPE_N_slots"):
            Renderer(device).render(Splats("other", arrays()), camera())
    finally:
        del SHAPES["other"]


def pinched(values: object) -> Splats:
    return Splats("pinched", {name: value.astype(np.float32) for name, value in (arrays() | {"pinch": values}).items()})


def test_a_parameter_is_never_dropped(shape: str, device: Device) -> None:
    """Splats with a parameter have no equal Gaussians; without, they have the same images."""
    some = np.where(np.arange(12) < 5, 0.5, 0.0)
    with pytest.raises(InputError, match=r"5 of 12 splats have pinch other than 0, which gaussian does not support"):
        convert(pinched(some), "gaussian")
    plain, renderer = pinched(np.zeros(12)), Renderer(device, "float64")
    for target in ("gaussian", "skew-normal-direct", "half-gaussian"):
        images = [renderer.render(splats, camera()).color for splats in (plain, convert(plain, target))]
        np.testing.assert_allclose(images[1], images[0], atol=1e-6)
    assert not convert(convert(plain, "gaussian"), shape).to_numpy()["pinch"].any()


def test_its_nearest_gaussians_are_nearer_than_its_core(shape: str, device: Device) -> None:
    splats, renderer = pinched(arrays()["pinch"]), Renderer(device, "float64")
    near, differs = nearest_of_shape(splats, "gaussian")
    assert differs
    core = Splats("gaussian", {name: value for name, value in splats.to_numpy().items() if name != "pinch"})
    want, *others = (renderer.render(model, camera()).color for model in (splats, near, core))
    errors = [np.square(other - want).mean() for other in others]
    assert errors[0] < 0.1 * errors[1]


def cosine(z: Array, fields: dict[str, Array]) -> Array:
    n = len(next(iter(fields.values())))
    return np.broadcast_to(np.where(np.abs(z) < 3, 0.5 + 0.5 * np.cos(np.pi * z / 3), 0.0), (n, 1, len(z)))


@pytest.fixture
def strange() -> Iterator[None]:
    """Shapes that are only converted, never drawn: one without Gaussians, and two with fields of the package."""
    other = {"record": 10, "moments": 10, "flops": (1, 1)}
    shapes = [
        Shape("cosine", GAUSSIAN.source, (), profile=cosine, **other),
        Shape("slanted", BISECTED_SKEW.source, (SLANT,), profile=GAUSSIAN.profile, **other),
        Shape("sided", BISECTED_SKEW.source, (OPACITY_MINUS, SLANT), profile=BISECTED_SKEW.profile, **other),
    ]
    for added in shapes:
        register_shape(added)
    yield
    for added in shapes:
        del SHAPES[added.name]


def test_a_shape_without_gaussians_has_no_equals(strange: None) -> None:
    core = {name: value for name, value in arrays().items() if name != "pinch"}
    without, gaussians = Splats("cosine", core), Splats("gaussian", core)
    for splats, target in ((without, "gaussian"), (without, "student-t"), (gaussians, "cosine")):
        with pytest.raises(InputError, match="because no cosine splat is a Gaussian") as caught:
            convert(splats, target)
        assert "\n" not in str(caught.value)
    near = nearest_gaussians(without)
    assert np.ptp(near.log_scale - without.log_scale) < 1e-9
    assert 0.0 < float((near.log_scale - without.log_scale)[0, 0]) < 0.5
    assert [name for name, known in SHAPES.items() if not known.holds_gaussian()] == ["cosine"]


def test_the_nearest_splats_are_offered_only_where_there_are_some(strange: None, tmp_path: Path) -> None:
    core = {name: value for name, value in arrays().items() if name != "pinch"}
    sides = {"skew": np.tile([0.0, 0.5, 0.0], (12, 1)), "opacity_minus_logit": core["opacity_logit"] + 1.0}
    none = Splats("skew-normal", core | {"skew": sides["skew"]}, normalisation="none")
    offered = []
    for splats, target in (
        (Splats("cosine", core), "gaussian"),  # its nearest Gaussians are known
        (Splats("cosine", core), "student-t"),
        (Splats("gaussian", core), "cosine"),  # no cosine splat is a Gaussian
        (Splats("sided", core | sides), "gaussian"),  # it has more than one number of its own
        (none, "gaussian"),  # its height changes with the view
        (Splats("gaussian", core), "unknown"),
    ):
        splats.save(tmp_path / "from.ply")
        with pytest.raises(InputError) as caught:
            convert_model(tmp_path / "from.ply", tmp_path / "to.ply", target)
        offered.append(str(caught.value).endswith("; or --approximate"))
    assert offered == [True, True, False, False, False, False]


def test_a_new_shape_of_the_package_without_bounds_has_nearest_gaussians(
    strange: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = Splats("cosine", {name: value for name, value in arrays().items() if name != "pinch"})
    want = nearest_gaussians(splats)
    monkeypatch.setattr(approximate, "PACKAGE_SHAPES", frozenset(SHAPES))
    np.testing.assert_array_equal(nearest_gaussians(splats).log_scale, want.log_scale)


def test_fields_of_the_package_have_no_rules_in_other_shapes(strange: None) -> None:
    core = {name: value for name, value in arrays().items() if name != "pinch"}
    skew = np.tile([0.0, 0.5, 0.0], (12, 1))
    with pytest.raises(InputError, match="12 of 12 splats have skew other than 0, 0, 0"):
        convert(Splats("slanted", core | {"skew": skew}), "gaussian")
    sides = core | {"skew": 0.0 * skew, "opacity_minus_logit": core["opacity_logit"] + 1.0}
    with pytest.raises(InputError, match="12 of 12 splats have opacity_minus_logit other than opacity_logit"):
        convert(Splats("sided", sides), "gaussian")
    with pytest.raises(InputError, match="nearest Gaussians of slanted are not known, because it has more than one"):
        nearest_gaussians(Splats("slanted", core | {"skew": skew}))
