"""Training hazards: a small scene or its options with a fault, beside the same run without the fault."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import clsplat
from clsplat.device.device import Device
from clsplat.device.program import OPTIONS_VARIABLE
from clsplat.errors import ClsplatError
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.initialise import initial_splats

from . import worlds
from .crafted import unit
from .variants import OPTIMIZERS, Variant

ITERATIONS, CAP, SH_DEGREE = 200, 400, 1
TOLERANCE_DB = 0.5
RATES = (
    "position_lr_init",
    "position_lr_final",
    "opacity_lr",
    "scaling_lr",
    "rotation_lr",
    "feature_lr",
    "normal_lr",
    "beta_lr",
    "nu_lr",
)

Start = Callable[[Splats], Splats]  # changes the splats that training starts from


@dataclass(frozen=True)
class Hazard:
    """One row of the table.

    Parameters
    ----------
    world : makes the scene from the benign one.
    options : of TrainConfig, in addition to those of the optimizer. rates : factor on all learning rates.
    start : changes the splats that training starts from.
    only : the optimizers that have this hazard; default: all.
    concerns : whether a variant has this hazard.
    build : options of every kernel build. other_device : run on the second usable device.
    """

    world: Callable[[Scene], Scene] = lambda scene: scene
    options: dict[str, Any] = field(default_factory=dict)
    rates: float = 1.0
    start: Start | None = None
    only: tuple[str, ...] = tuple(OPTIMIZERS)
    concerns: Callable[[Variant], bool] = lambda variant: True
    build: str = ""
    other_device: bool = False


def changed(splats: Splats, every: int = 10, **values: Any) -> Splats:
    """Return the splats with other values in every tenth splat, or in all."""
    arrays = splats.to_numpy()
    for name, new in values.items():
        arrays[name][::every] = new[::every]
    return Splats(splats.shape, arrays, splats.normalisation)


def needles(splats: Splats) -> Splats:
    """Return the splats with a tenth of them turned into needles of 1:10^4."""
    log_scale = splats.log_scale.copy()
    log_scale[:, 1:] += np.float32(np.log(1e-4))
    return changed(splats, log_scale=log_scale)


def fields_at_bound(splats: Splats) -> Splats:
    """Return the splats with the shape-specific fields at their limits, vectors in random directions."""
    rng, values = np.random.default_rng(1), splats.to_numpy()
    for spec in SHAPES[splats.shape].fields:
        if spec.limit is not None:
            values[spec.name] = (spec.limit * unit(rng.normal(size=values[spec.name].shape))).astype(np.float32)
        elif spec.bounds is not None:
            values[spec.name] = np.resize(np.array(spec.bounds, np.float32), len(splats))
    return Splats(splats.shape, values, splats.normalisation)


def has_limit(variant: Variant) -> bool:
    """Return whether a field of the shape is bounded."""
    return any(f.limit is not None or f.bounds is not None for f in SHAPES[variant.shape].fields)


def is_skewed(variant: Variant) -> bool:
    """Return whether the shape has a skew."""
    return SHAPES[variant.shape].skew_form is not None


def scale_of(splats: Splats, factor: float) -> Splats:
    """Return the splats with a tenth of them scaled."""
    return changed(splats, log_scale=splats.log_scale + np.float32(np.log(factor)))


def opacity_of(splats: Splats, value: float, every: int = 10) -> Splats:
    """Return the splats with another opacity in every tenth splat, or in all."""
    raw = np.full(len(splats), SHAPES[splats.shape].raw_opacity(np.float64(value)), np.float32)
    return changed(splats, every, **{name: raw for name in splats.arrays if name.startswith("opacity")})


TWO = ("adam", "mcmc")  # adding and removing splats matters more than how positions move

TRAINING: dict[str, Hazard] = {
    "all rates x10": Hazard(rates=10),
    "all rates x100": Hazard(rates=100),
    "rate of skew x100": Hazard(options={"skew_lr": 0.25}, concerns=is_skewed),
    "rate of rotation x100": Hazard(options={"rotation_lr": 0.1}),
    "SGHMC, C x100": Hazard(options={"sghmc_friction": 1.2e4}, only=("sghmc",)),
    "SGHMC as SSS, C x100": Hazard(
        options={"sghmc_friction": 1.2e4, "position_optimizer": "sghmc-sss", "sghmc_burn_in": 0.0}, only=("sghmc",)
    ),
    "SGHMC as SSS, scene x100": Hazard(
        lambda s: worlds.in_units(s, 100),
        only=("sghmc",),
        options={"position_optimizer": "sghmc-sss", "sghmc_burn_in": 0.0},
    ),
    "scene x1e-3": Hazard(lambda s: worlds.in_units(s, 1e-3)),
    "scene x1e-2": Hazard(lambda s: worlds.in_units(s, 1e-2)),
    "scene x1e2": Hazard(lambda s: worlds.in_units(s, 1e2)),
    "scene x1e4": Hazard(lambda s: worlds.in_units(s, 1e4)),
    "one image": Hazard(lambda s: worlds.of_first(s, 1)),
    "two images": Hazard(lambda s: worlds.of_first(s, 2)),
    "one photo exposed twice as long": Hazard(worlds.badly_exposed),
    "random initialisation": Hazard(options={"init": "random"}),
    "points doubled": Hazard(lambda s: worlds.with_points(s, "doubled"), only=TWO),
    "points all in one place": Hazard(lambda s: worlds.with_points(s, "coincident"), only=TWO),
    "points far out": Hazard(lambda s: worlds.with_points(s, "outliers"), only=TWO),
    "four points": Hazard(lambda s: worlds.with_points(s, "four"), only=TWO),
    "a tenth needles 1:10^4": Hazard(start=needles, only=TWO),
    "start: skew (own) at its bound": Hazard(start=fields_at_bound, concerns=has_limit, only=TWO),
    "a tenth 100 times as large": Hazard(start=lambda s: scale_of(s, 100), only=TWO),
    "a tenth 1e-6 times as large": Hazard(start=lambda s: scale_of(s, 1e-6), only=TWO),
    "a tenth of opacity 0.9999": Hazard(start=lambda s: opacity_of(s, 0.9999), only=TWO),
    "a tenth of opacity 1/255": Hazard(start=lambda s: opacity_of(s, 1 / 255), only=TWO),
    "all transparent": Hazard(start=lambda s: opacity_of(s, 1e-3, every=1), only=TWO),
    "relocation every 5 iterations": Hazard(
        start=fields_at_bound,
        only=("mcmc",),
        options={"densify_interval": 5, "densify_until": 1.0, "opacity_reg": 0.05},
    ),
    "NumPy optimizer": Hazard(options={"optimizer": "numpy"}, only=("adam",)),
    "fast-math build": Hazard(build="-cl-fast-relaxed-math", only=("adam",)),
    "another OpenCL runtime": Hazard(other_device=True, only=("adam",)),
}


@dataclass
class Trainings:
    """Training runs on one device; each benign twin runs once.

    Parameters
    ----------
    other : a second device, or None.
    """

    device: Device
    other: Device | None = None
    iterations: int = ITERATIONS
    views: int = worlds.VIEWS
    twins: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.renderer = Renderer(self.device)

    def row(self, name: str, variant: Variant, optimizer: str) -> dict[str, Any] | None:
        """Run one hazard; return None if the variant or the optimizer does not have it."""
        hazard, scene = TRAINING[name], worlds.capture(self.views)
        if (hazard.other_device and self.other is None) or not hazard.concerns(variant) or optimizer not in hazard.only:
            return None
        twin = self.twin(variant, optimizer)
        world = hazard.world(scene)
        result = self.run(world, variant, optimizer, hazard)
        judged = [view.name for view in (world.test or world.train)]
        row: dict[str, Any] = {key: result[key] for key in ("finite", "message", "seconds", "diverged_at")}
        row |= {"psnr": None, "twin_psnr": float(np.mean([twin[name] for name in judged]))}
        if not result["finite"]:
            return row | {"verdict": "fails"}
        if result["message"]:
            return row | {"verdict": "stops"}
        psnr = float(np.mean([result["psnr"][view] for view in judged]))
        lost = row["twin_psnr"] - psnr
        return row | {"psnr": psnr, "lost_db": lost, "verdict": "survives" if lost <= TOLERANCE_DB else "loses"}

    def twin(self, variant: Variant, optimizer: str) -> dict[str, float]:
        """Return the PSNR of every view after the run without a fault."""
        key = (variant.label, optimizer)
        if key not in self.twins:
            self.twins[key] = self.run(worlds.capture(self.views), variant, optimizer, Hazard())["psnr"]
        return self.twins[key]

    def run(self, world: Scene, variant: Variant, optimizer: str, hazard: Hazard) -> dict[str, Any]:
        """Train into a folder, and check every file of it."""
        config = TrainConfig(
            **(
                variant.options
                | {
                    "iterations": self.iterations,
                    "cap_max": CAP,
                    "sh_degree": SH_DEGREE,
                    "densify_interval": 20,
                    "checkpoint_interval": 50,
                }
                | OPTIMIZERS[optimizer]
                | rates_of(hazard, variant)
                | hazard.options
            )
        )
        device = self.other if hazard.other_device and self.other is not None else self.device
        config = config.replace(device=device.info.index)
        result: dict[str, Any] = {"message": "", "psnr": {}, "diverged_at": None}
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder, build_options(hazard.build):
            out = Path(folder) / "model"
            if hazard.start is not None:
                first, _ = initial_splats(
                    world,
                    config.shape,
                    config.cap_max,
                    SH_DEGREE,
                    opacity=config.density.init_opacity,
                    scale_factor=config.density.init_scale,
                )
                file = Path(folder) / "start.ply"
                hazard.start(first).save(file)
                config = TrainConfig.from_json(config.to_json() | {"init": str(file)})
            try:
                model = clsplat.train(world, config, output=out)
                result["psnr"] = {
                    name: view["PSNR"]
                    for name, view in evaluate(self.renderer, model.splats, world.views).per_view.items()
                }
            except ClsplatError as error:
                result["message"] = str(error).replace(str(world.path), world.name)
            result["seconds"] = time.perf_counter() - start
            result["finite"] = all(finite_file(path) for path in out.rglob("*.ply"))
            result["diverged_at"] = diverged_at(out / "log.jsonl")
        return result


@contextmanager
def build_options(options: str) -> Iterator[None]:
    """Add options to every kernel build for a while."""
    before = os.environ.get(OPTIONS_VARIABLE)
    if options:
        os.environ[OPTIONS_VARIABLE] = options
    try:
        yield
    finally:
        if options:
            os.environ.pop(OPTIONS_VARIABLE)
            if before is not None:
                os.environ[OPTIONS_VARIABLE] = before


def rates_of(hazard: Hazard, variant: Variant) -> dict[str, Any]:
    """Return every learning rate times the factor of the hazard."""
    if hazard.rates == 1:
        return {}
    options = TrainConfig(**variant.options).to_json()
    values = {name: hazard.rates * options[name] for name in RATES}
    skew = [f.lr for f in SHAPES[variant.shape].fields if f.name == "skew"]
    return values | ({"skew_lr": hazard.rates * skew[0]} if skew else {})


def finite_file(path: Path) -> bool:
    """Return whether a written model loads; a model with a NaN or an infinity does not."""
    try:
        splats = Splats.load(path)
    except ClsplatError:
        return False
    return all(bool(np.isfinite(values).all()) for values in splats.arrays.values())


def diverged_at(log: Path) -> int | None:
    """Return the iteration after which the loss stays above that of the first report; None if there is none."""
    if not log.exists():
        return None
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    losses = [(row["iteration"], row["loss"]) for row in rows if "loss" in row]
    bad = None
    for iteration, loss in reversed(losses[1:]):
        if loss <= losses[0][1]:
            break
        bad = iteration
    return bad
