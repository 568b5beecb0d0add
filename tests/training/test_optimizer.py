"""Optimizers: kernels agree with NumPy step by step. Edits, bounded fields, frozen groups and states are tested too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference.noise import add_noise

from clsplat.device.device import Device
from clsplat.device.schedule import default_schedule
from clsplat.errors import InputError
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.splat_buffers import CompactGradients, SplatBuffers
from clsplat.splats.fields import Group
from clsplat.splats.harmonics import sh_basis
from clsplat.splats.shapes import SHAPES, shape_named
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.density.edit import DensifyEdit, NewValues
from clsplat.training.optim.optimizer import Optimizer, make_optimizer
from clsplat.training.optim.regularisers import Penalty
from clsplat.training.optim.skew_map import MAPS, SKEW_MAPS
from clsplat.training.programs import optim_program

CAPACITY = 400
EXTENT = 3.0
ITERATIONS = 30_000  # rates have no factor at this number
MEAN_LR = 1e-3
TOLERANCE = 3e-6  # ten float32 steps: some ulp of the value or vector, and of ten steps of at most the rate

SGHMC = {"position_optimizer": "sghmc", "sghmc_burn_in": 4.5 / ITERATIONS}
CASES = [
    {"shape": "gaussian"},
    {"shape": "gaussian", "strategy": "adc", "opacity_reg": 3.0, "scale_reg": 2.0},
    *({"shape": "skew-normal", "skew_map": name} for name in MAPS["centred"]),
    *({"shape": "skew-normal-direct", "skew_map": name} for name in MAPS["direct"]),
    {"shape": "half-gaussian", **SGHMC, "bisect_reg": 3.0},
    {"shape": "generalised-exponential"},
    {"shape": "student-t", **SGHMC, "position_optimizer": "sghmc-sss"},
    {
        "shape": "bisected-skew",
        "skew_map": "coupled",
        **SGHMC,
        "alternation": "cyclic",
        "alternation_warmup": 2.5 / ITERATIONS,
        "alternation_cycle": 3,
    },
]


def some_directions() -> np.ndarray:
    """Unit vectors with no basis function near 0, because Adam divides the rounding of a gradient by its size."""
    found = np.random.default_rng(2).standard_normal((4000, 3))
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found[np.abs(sh_basis(found, 3)).min(axis=1) > 0.05]


DIRECTIONS = some_directions()


def some_splats(shape: str, n: int = 300, sh_degree: int = 2) -> Splats:
    """Random splats, some nearly transparent. Bounded fields cover their whole range."""
    rng = np.random.default_rng(5)
    arrays: dict[str, np.ndarray] = {"sh": 0.5 * rng.standard_normal((n, (sh_degree + 1) ** 2, 3))}
    for field in shape_named(shape).schema(sh_degree).group(Group.GEOM):
        size = (n,) if field.width == 1 else (n, field.width)
        values = rng.standard_normal(size)
        if field.bounds is not None:
            values = np.exp(rng.uniform(*np.log(field.bounds), size))
        elif field.limit is not None:
            # Ten steps do not reach 0 from here. At 0 the cube-root map is steep and amplifies rounding.
            length = field.limit * rng.uniform(0.45, 0.95, (n, 1))
            values *= length / np.linalg.norm(values, axis=1, keepdims=True)
        elif field.name == "log_scale":
            values = rng.uniform(-3.5, -1.5, size)
        elif "opacity" in field.name:
            values = rng.uniform(-7, 3, size)
            values[: n // 4] = 1e-2 * rng.standard_normal(n // 4)  # with a signed shape these are transparent
        arrays[field.name] = values
    return Splats(shape, {name: array.astype(np.float32) for name, array in arrays.items()})


def words(options: dict[str, object]) -> str:
    return "-".join(value for value in options.values() if isinstance(value, str))


def config_of(**options: object) -> TrainConfig:
    return TrainConfig(**({"iterations": ITERATIONS, "seed": (7 << 32) + 3} | options))  # type: ignore[arg-type]


def kernels_of(device: Device, config: TrainConfig, sh_degree: int = 2) -> KernelBuild:
    return KernelBuild(config.shape, sh_degree, default_schedule(device.info), skew_map=config.skew_map or SKEW_MAPS[0])


def started(device: Device, config: TrainConfig, splats: Splats) -> tuple[SplatBuffers, Optimizer]:
    kernels = kernels_of(device, config, splats.schema.sh_degree)
    buffers = SplatBuffers.of(device, splats, kernels.dtype, CAPACITY)
    return buffers, make_optimizer(device, kernels, buffers, config, EXTENT)


def gradients(buffers: SplatBuffers, rng: np.random.Generator) -> dict[str, np.ndarray]:
    grads = {
        name: rng.standard_normal(array.shape).astype(np.float32)
        for name, array in buffers.download(buffers.n).items()
        if name != "sh"
    }
    colour = rng.standard_normal((buffers.n, 2, 3)).astype(np.float32)  # the gradient of the colour, and the direction
    colour[:, 1] = rng.choice(DIRECTIONS, buffers.n)
    return grads | {"sh": colour}


def ones(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return gradients of 1 everywhere, with directions that give every SH coefficient a gradient."""
    colour = np.ones((len(arrays["mean"]), 2, 3), np.float32)
    colour[:, 1] = np.sqrt([0.15, 0.25, 0.6])
    return {key: np.ones_like(value) for key, value in arrays.items()} | {"sh": colour}


def step(
    buffers: SplatBuffers, optimizer: Optimizer, grads: dict[str, np.ndarray], iteration: int, sh_degree: int = 2
) -> None:
    on_device = CompactGradients(buffers.device, buffers.schema, CAPACITY, buffers.dtype)
    on_device.upload(grads)
    optimizer.step(on_device, MEAN_LR, sh_degree, iteration)


def growing(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> DensifyEdit:
    """Edit as a relocation does: some rows become copies, 40 are added, and states do not move."""
    n = len(arrays["mean"])
    source = np.concatenate([np.arange(n), rng.integers(0, n, 40)])
    source[: n // 5] = rng.integers(n // 2, n, n // 5)
    fresh = np.zeros(n + 40, bool)
    fresh[rng.integers(0, n, 30)] = True
    fresh[n : n + 20] = True  # the other new rows start without state too
    some = np.arange(n // 10, n + 30)
    values = {
        "opacity_logit": NewValues(np.arange(n + 40), arrays["opacity_logit"][source] - 1),
        "log_scale": NewValues(some, arrays["log_scale"][source[some]] - 0.1),
    }
    return DensifyEdit(source, values, fresh)


def shrinking(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> DensifyEdit:
    """Edit as pruning with a reset does: 100 rows are removed and states move. Some rows change rotation or skew."""
    n = len(arrays["mean"])
    source = rng.permutation(n)[: n - 100]
    fresh = np.zeros(n - 100, bool)
    fresh[::7] = True
    moved = {name: array[source].copy() for name, array in arrays.items()}
    moved["quat"][3] = [0.5, 0.1, -0.2, 0.7]
    rows = np.arange(n - 100)
    values = {"mean": NewValues(rows, moved["mean"] + 0.1), "quat": NewValues(rows[2:5], moved["quat"][2:5])}
    if "skew" in moved:
        moved["skew"][5:9] *= -0.5
        values["skew"] = NewValues(rows[4:20], moved["skew"][4:20])
    resets = ("opacity_logit", "mean", "sh", *(("skew",) if "skew" in moved else ()))
    return DensifyEdit(source, values, fresh, state_source=source, reset_fields=resets)


@pytest.mark.parametrize("options", CASES, ids=words)
def test_fused_steps_equal_numpy(device: Device, options: dict[str, object]) -> None:
    """Both optimizers get the same gradients. Growth, shrinking and another growth come between the steps."""
    config = config_of(**options)
    splats = some_splats(config.shape)
    both = {name: started(device, replace(config, optimizer=name), splats) for name in ("fused", "numpy")}
    buffers = both["numpy"][0]
    rng = np.random.default_rng(8)
    edits = {3: growing, 5: shrinking, 8: growing}
    for iteration, degree in enumerate([0] * 3 + [1] * 3 + [2] * 4, start=1):
        start = buffers.download(buffers.n)
        grads = gradients(buffers, rng)
        for target, optimizer in both.values():
            step(target, optimizer, grads, iteration, degree)
        if iteration in edits:
            for target, optimizer in both.values():  # each edits its own values: copies must be equal to the bit
                optimizer.apply(edits[iteration](target.download(target.n), np.random.default_rng(iteration)))
        else:
            moved = buffers.download(buffers.n)
            learns = {True: "skew" in moved, False: True}
            if config.phases.alternation == "cyclic" and iteration > 2:
                skew_turn = (iteration - 3) % 3 >= 2
                learns = {True: skew_turn, False: not skew_turn}
            for name in moved:
                turns = name == "skew" and config.skew_map == "coupled"  # the coupled skew also moves with the rotation
                assert np.any(moved[name] != start[name]) == (learns[name == "skew"] or turns), name
    fused, numpy = (target.download(target.n) for target, _ in both.values())
    for name, expected in numpy.items():
        length = splats.schema[name].limit or 1.0
        np.testing.assert_allclose(fused[name], expected, TOLERANCE, TOLERANCE * length, err_msg=name)
    states = [dict(optimizer.state()) for _, optimizer in both.values()]
    assert set(states[0]) == set(states[1])
    for name, expected in states[1].items():
        near = 3e-5 if name == "momentum" else 1e-6  # the gate amplifies the rounding of an opacity a hundred times
        np.testing.assert_allclose(states[0][name], expected, near, 1e-6 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize("name", ["fused", "numpy"])
def test_an_edit_moves_parameters_and_states(devices: list[Device], name: str) -> None:
    """Parameters equal DensifyEdit.apply, states DensifyEdit.apply_state. s is inverted only if the skew changed."""
    config = config_of(shape="bisected-skew", skew_map="polar", optimizer=name, **SGHMC)
    buffers, optimizer = started(devices[0], config, some_splats(config.shape))
    rng = np.random.default_rng(3)
    for iteration, make_edit in enumerate((shrinking, growing), start=1):
        step(buffers, optimizer, gradients(buffers, rng), iteration)
        old, state = buffers.download(buffers.n), dict(optimizer.state())
        edit = make_edit(old, rng)
        optimizer.apply(edit)
        moved, after = buffers.download(buffers.n), dict(optimizer.state())
        for field, expected in edit.apply(old).items():
            np.testing.assert_array_equal(moved[field], expected, err_msg=field)
        for key in state:
            role, _, field = key.partition(".")
            if role in ("first", "second", "momentum"):
                expected = edit.apply_state(state[key], field or "mean")
                np.testing.assert_array_equal(after[key], expected, err_msg=key)
        changed = (moved["skew"] != old["skew"][edit.source]).any(axis=1)
        assert changed.sum() == (4 if make_edit is shrinking else 0)
        np.testing.assert_array_equal(after["skew_s"][~changed], state["skew_s"][edit.source][~changed])
        np.testing.assert_allclose(np.linalg.norm(after["skew_s"][changed, 1:], axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize("name", ["fused", "numpy"])
def test_a_frozen_group_keeps_values_moments_and_count(devices: list[Device], name: str) -> None:
    config = config_of(
        shape="skew-normal-direct", optimizer=name, alternation="cyclic", alternation_warmup=0, alternation_cycle=4
    )  # two iterations for each group
    buffers, optimizer = started(devices[0], config, some_splats(config.shape))
    rng = np.random.default_rng(3)
    for iteration in range(1, 7):
        before = dict(optimizer.state()) | buffers.download(buffers.n)
        step(buffers, optimizer, gradients(buffers, rng), iteration)
        after = dict(optimizer.state()) | buffers.download(buffers.n)
        base = (iteration - 1) % 4 < 2
        for key in set(before) - {"steps"}:
            assert np.array_equal(before[key], after[key]) == (("skew" in key) == base), key
        np.testing.assert_array_equal(after["steps"] - before["steps"], [base, not base])


@pytest.mark.parametrize("name", ["fused", "numpy"])
@pytest.mark.parametrize(("shape", "field"), [("generalised-exponential", "beta"), ("student-t", "nu")])
def test_bounded_fields_move_by_factors_and_stay_within(
    devices: list[Device], name: str, shape: str, field: str
) -> None:
    config = config_of(shape=shape, optimizer=name, **{f"{field}_lr": 0.05})
    splats = some_splats(shape)
    low, high = splats.schema[field].bounds or (0, 0)
    arrays = splats.to_numpy()
    arrays[field][:3] = low, high, 2.0
    buffers, optimizer = started(devices[0], config, Splats(shape, arrays))
    grads = ones(arrays)
    grads[field][1] = -1
    step(buffers, optimizer, grads, 1)
    got = buffers.download(buffers.n)[field]
    np.testing.assert_allclose(got[:3], [low, high, 2 * np.exp(-0.05)], rtol=1e-6)  # Adam's first step equals the rate
    for iteration in range(2, 30):
        step(buffers, optimizer, grads, iteration)
    got = buffers.download(buffers.n)[field]
    assert got.min() == np.float32(low)
    assert got.max() == np.float32(high)


def test_a_state_continues_to_the_same_bits_and_goes_from_one_optimizer_to_the_other(devices: list[Device]) -> None:
    config = config_of(**CASES[-1])
    buffers, optimizer = started(devices[0], config, some_splats(config.shape))
    rng = np.random.default_rng(3)
    for iteration in range(1, 7):
        step(buffers, optimizer, gradients(buffers, rng), iteration)
    state, splats = dict(optimizer.state()), Splats(config.shape, buffers.download(buffers.n))
    grads = gradients(buffers, rng)
    step(buffers, optimizer, grads, 7)
    for name, tolerance in (("fused", 0.0), ("numpy", TOLERANCE)):
        others, other = started(devices[0], replace(config, optimizer=name), splats)
        other.load_state(state)
        step(others, other, grads, 7)
        for key, expected in buffers.download(buffers.n).items():
            np.testing.assert_allclose(others.download(others.n)[key], expected, tolerance, 10 * tolerance)
        for key in ("momentum", "skew_s", "first.nu"):
            odd = {k: v for k, v in state.items() if k != key} if key in state else state | {key: state["steps"]}
            with pytest.raises(InputError, match=key):
                other.load_state(odd)
        for key in ("steps", "second.mean", "momentum"):
            with pytest.raises(InputError, match=f"{key}.*shape"):
                other.load_state(state | {key: state[key].ravel()[:1]})


def test_every_field_has_a_rate(devices: list[Device]) -> None:
    """All fields of all shapes move. The second opacity has the learning rate of the first."""
    for shape in SHAPES:
        config = config_of(shape=shape, opacity_lr=0.03)
        splats = some_splats(shape, 20, 0)
        buffers, optimizer = started(devices[0], config, splats)
        step(buffers, optimizer, ones(splats.to_numpy()), 1, 0)
        for key, moved in buffers.download(buffers.n).items():
            change = np.abs(moved - splats.to_numpy()[key])
            assert np.all(change.reshape(len(change), -1).max(axis=1) > 0), (shape, key)
            if "opacity" in key:
                np.testing.assert_allclose(change, 0.03, rtol=1e-4)


# --- regularisers and other parts of the step -------------------------------------------------


@pytest.mark.parametrize("shape", ["gaussian", "bisected-skew", "student-t"])
def test_regularisers_are_the_gradients_of_their_penalties(shape: str) -> None:
    """Penalties are the mean |opacity| of a splat's sides, the scale, and the squared difference of two sides."""
    kind = shape_named(shape)

    def penalty(arrays: dict[str, np.ndarray]) -> np.ndarray:
        sides = [kind.opacity(arrays[key]) for key in arrays if "opacity" in key]
        gap = sides[0] - sides[-1]
        return 0.3 * np.abs(sides).mean(axis=0) + 0.2 * np.exp(arrays["log_scale"]).sum(axis=1) + 0.7 * gap**2

    arrays = {key: array.astype(np.float64) for key, array in some_splats(shape).to_numpy().items()}
    grads = Penalty(0.3, 0.2, 0.7).gradients(kind, arrays)
    assert set(grads) == {key for key in arrays if "opacity" in key or key == "log_scale"}
    for key, got in grads.items():
        for column, values in enumerate(got.reshape(len(got), -1).T):
            up, down = ({k: a.copy() for k, a in arrays.items()} for _ in range(2))
            up[key].reshape(len(got), -1)[:, column] += 1e-6
            down[key].reshape(len(got), -1)[:, column] -= 1e-6
            np.testing.assert_allclose(values, (penalty(up) - penalty(down)) / 2e-6, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("shape", ["bisected-skew", "student-t"])
def test_mcmc_noise_follows_the_stronger_opacity_of_either_sign(devices: list[Device], shape: str) -> None:
    device, splats, kind = devices[0], some_splats(shape), shape_named(shape)
    kernels = kernels_of(device, config_of(shape=shape))
    buffers = SplatBuffers.of(device, splats, kernels.dtype)
    optim_program(device, kernels).mcmc_noise.over(
        -(-buffers.n // kernels.lanes),
        geom=buffers.geom,
        capacity=buffers.capacity,
        n_splats=buffers.n,
        seed_lo=3,
        seed_hi=7,
        iteration=9,
        amount=50.0,
        reach=0.05,
    )
    arrays = splats.to_numpy()
    strength = kind.strength(arrays)
    assert np.sum(strength < 0.05) > 5
    expected = add_noise(splats.mean, splats.quat, splats.log_scale, strength, (7 << 32) + 3, 9, 50.0, 0.05)
    shifts = np.linalg.norm(expected - splats.mean, axis=1)
    assert shifts.max() == pytest.approx(0.05, rel=1e-5), "held back"
    assert 1e-3 < np.median(shifts[strength < 0.05]) <= 0.05 + 1e-6
    np.testing.assert_allclose(buffers.download(buffers.n)["mean"], expected, rtol=1e-6, atol=2e-5)
