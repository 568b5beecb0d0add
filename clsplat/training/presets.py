"""Presets: the published systems as values of `TrainConfig`, each constant with its source.

A preset sets the kernel, the optimizer, the strategy and the published constants, and nothing else: the cap, the
number of iterations, the image schedule and what no paper says are clsplat's, equal for all systems. Published
rates belong to runs of 30 000 iterations, as clsplat's do (`TrainConfig.rate_factor`); moments of a run are fractions
of the published one. "Code" is the authors' release: it counts where it differs from the paper, as the published
numbers are its.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..errors import InputError

Values = dict[str, Any]

# What makes a system the one it is: a flag may repeat these, not change them.
IDENTITY = ("shape", "normalisation", "strategy", "position_optimizer", "alternation", "skew_map")


def _gaussian_splatting() -> Values:
    """3DGS (Kerbl et al., SIGGRAPH 2023), code.

    Rates: positions 1.6e-4 to 1.6e-6 times the scene's extent, colour 2.5e-3 (bands above the constant a 20th), opacity
    0.05 (0.025 since October 2024), scale 5e-3, rotation 1e-3. Loss 0.8 L1 + 0.2 (1 - SSIM), no regulariser, no noise.
    First opacity 0.1, scale the distance to the three neighbours. Every 100 iterations from 500 to 15 000 of 30 000:
    mean gradient above 2e-4, clone below 0.01 of the extent and split above. Opacities are reset every 3000 of 30 000.
    """
    return {
        "shape": "gaussian",
        "strategy": "adc",
        "position_optimizer": "adam",
        "alternation": "off",
        "position_lr_init": 1.6e-4,
        "position_lr_final": 1.6e-6,
        "feature_lr": 2.5e-3,
        "opacity_lr": 0.05,
        "scaling_lr": 5e-3,
        "rotation_lr": 1e-3,
        "lambda_dssim": 0.2,
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
        "bisect_reg": 0.0,
        "noise_lr": 0.0,
        "init_opacity": 0.1,
        "init_scale": 1.0,
        "random_points": 0.0,
        "densify_from": 500 / 30_000,
        "densify_until": 15_000 / 30_000,
        "densify_interval": 100,
        "grad_threshold": 2e-4,
        "depth_threshold": 0.0,
        "dense_size": 0.01,
        "opacity_reset": 10,
    }


def _generalised_exponential() -> Values:
    """GES (Hamdi et al., CVPR 2024), code: 3DGS with 40 000 iterations, threshold 3e-4, and beta as a factor of scale.

    The kernel is the released one, which only scales the Gaussian; the paper's is `generalised-exponential`. Rate of
    beta 1e-3, here of log beta, so 1e-3 / 2 at the Gaussian's beta = 2. Densification ends at 15 000 of 40 000;
    opacities are reset every 3000. Left out: the L1 masked by a difference of Gaussians (weight 0.5), the reset of
    beta every 1000 iterations and the removal of splats that beta has shrunk below 0.005.
    """
    return _gaussian_splatting() | {
        "shape": "ges-modulation",
        "beta_lr": 5e-4,
        "grad_threshold": 3e-4,
        "densify_from": 500 / 40_000,
        "densify_until": 15_000 / 40_000,
        "opacity_reset": 13,
    }


def _half_gaussian() -> Values:
    """3D-HGS (Li et al., CVPR 2025), code: 3DGS with two opacities a splat, divided by a plane.

    Rate of the normal 3e-3 (0.3 for Deep Blending, paper); densification until 20 000 of 30 000; threshold 2e-4. The
    plane is projected exactly, not by the release's approximation. Left out: the opacities' rate divided by 1.4 every
    5000 iterations, and the one first normal (0.6, 0.6, 0.6): here each splat starts with a random one.
    """
    return _gaussian_splatting() | {"shape": "half-gaussian", "normal_lr": 3e-3, "densify_until": 20_000 / 30_000}


def _mcmc() -> Values:
    """3DGS-MCMC (Kheradmand et al., NeurIPS 2024), paper and code.

    3DGS's rates; opacity and scale regularisers 0.01 each (0.001 of opacity for drjohnson), noise 5e5 times the
    positions' rate; first opacity 0.5, scale a tenth of the distance to the neighbours. Every 100 iterations from 500
    to 25 000 of 30 000 all dead splats are relocated (opacity and scale by the Gaussian's coefficient), and 5 % added.
    """
    return _gaussian_splatting() | {
        "strategy": "mcmc",
        "relocation": "length",
        "relocation_limit": 1.0,
        "growth": 1.05,
        "opacity_reg": 0.01,
        "scale_reg": 0.01,
        "noise_lr": 5e5,
        "init_opacity": 0.5,
        "init_scale": 0.1,
        "densify_until": 25_000 / 30_000,
        "opacity_reset": 0,
    }


def _student_t() -> Values:
    """SSS (Zhu et al., CVPR 2025), code: Student's t, signed opacities, recycling, SGHMC for positions.

    Opacity 5e-3, regularisers 0.01 each (0.005 of opacity for Deep Blending), first opacity 0.5, scale a tenth of the
    distance. SGHMC as written: C = 120 (100 for Deep Blending) after a burn-in of 7000 iterations with 5e5 (bicycle,
    stump: 15 000 with 5e8); fractions of 30 000, over which its rate decays, though most scenes ran 40 000. At most
    5 % of the splats are relocated at a time, their scale by the square of the coefficient; growth 5 %. Rate of nu
    10, halved every 5000 iterations, from nu = 100: here of log nu and constant, the mean 0.033 of 10 / 100 and its
    halves. Not as released: the derivative by nu is the correct one, the low-pass of 0.3 px^2 stays on.
    """
    return _mcmc() | {
        "shape": "student-t",
        "position_optimizer": "sghmc-sss",
        "sghmc_friction": 120.0,
        "sghmc_burn_in": 7000 / 30_000,
        "sghmc_burn_in_friction": 5e5,
        "noise_lr": 0.0,
        "opacity_lr": 5e-3,
        "nu_lr": 0.033,
        "relocation": "length-squared",
        "relocation_limit": 0.05,
    }


def _skew_normal() -> Values:
    """SNS (Wu et al. 2026), paper: the skew-normal about its location, unnormalised, SGHMC and alternating blocks.

    exp times Phi without a factor, the skew as bounded magnitude and free direction, positions by SGHMC, the rest by
    Adam, a joint warm-up and then cycles of one block after the other, and no regulariser.

    Not published; here: the rate of the skew, 1.25e-2 (5 times the centred form's, best in 2D trials); the bound of
    the slant, 10; warm-up, cycle and split: clsplat's defaults; first opacity and scale: clsplat's with "mcmc";
    SGHMC's constants: SSS's, in the stable form; the strategy: SSS's relocation without its square (times and
    baselines suggest SSS's code); the rates of all else: clsplat's defaults, which are 3DGS's.
    """
    return {
        "shape": "skew-normal-direct",
        "normalisation": "none",
        "skew_map": "polar",
        "skew_lr": 1.25e-2,
        "strategy": "mcmc",
        "relocation": "length",
        "relocation_limit": 0.05,
        "growth": 1.05,
        "position_optimizer": "sghmc",
        "sghmc_friction": 120.0,
        "sghmc_burn_in": 7000 / 30_000,
        "sghmc_burn_in_friction": 5e5,
        "noise_lr": 0.0,
        "alternation": "cyclic",
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
        "bisect_reg": 0.0,
        "lambda_dssim": 0.2,
        "densify_from": 500 / 30_000,
        "densify_until": 25_000 / 30_000,
        "densify_interval": 100,
        "random_points": 0.0,
    }


def _bisected_skew() -> Values:
    """3DSGS (Zhao et al. 2026), paper: 3DGS with a skew, two opacities a splat, and depth-aware densification.

    Splits where the gradient of the screen position or the one along the ray is above its threshold, and regularises
    the pair of opacities.

    Not published; here: the second threshold, 1e-5 of a gradient times the scene's extent, which on two captures of 50
    to 100 px about as many splats exceed as the first; the weight of the regulariser, 0.001 as clsplat's others; the
    rate of the skew, 1.25e-2 as for SNS; all other rates and the first threshold: 3DGS's.
    """
    return _gaussian_splatting() | {
        "shape": "bisected-skew",
        "skew_lr": 1.25e-2,
        "depth_threshold": 1e-5,
        "bisect_reg": 0.001,
    }


PRESETS: dict[str, Callable[[], Values]] = {
    "3dgs": _gaussian_splatting,
    "ges": _generalised_exponential,
    "3d-hgs": _half_gaussian,
    "sss": _student_t,
    "sns": _skew_normal,
    "3dsgs": _bisected_skew,
    "3dgs-mcmc": _mcmc,
}


def preset(name: str) -> Values:
    """TrainConfig's values of a published system.

    Raises
    ------
    InputError : no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}: choose one of {', '.join(PRESETS)}")
    return PRESETS[name]()


def with_preset(name: str, given: Mapping[str, Any]) -> Values:
    """The preset's values, replaced by those given.

    Parameters
    ----------
    given : values by TrainConfig's names, such as the flags of a command line.

    Raises
    ------
    InputError : no such preset, or a value that contradicts what makes the system (IDENTITY).
    """
    values = preset(name)
    for key in IDENTITY:
        if key in values and given.get(key, values[key]) != values[key]:
            raise InputError(
                f"preset {name} has {key} {values[key]}, which contradicts {key} {given[key]}: leave out one of the two"
            )
    return values | dict(given)
