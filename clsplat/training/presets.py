"""Presets: the published systems as options of `TrainConfig`, each constant with its source.

A preset sets the kernel, the optimizer, the strategy and the published constants. It does not set the cap, the number
of iterations or the image schedule, which are equal for all systems of a comparison. `clsplat benchmark` alone trains
presets on images at full size from the first iteration, as published. Published learning rates and the
defaults belong to runs of 30 000 iterations (`TrainConfig.rate_factor`). Times within a run are fractions of the
published run length. "Code" means the constants of the authors' release. They replace those of the paper, because the
published results come from the release.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..errors import InputError

Values = dict[str, Any]

# Options that define a system: a flag may repeat their values, but not change them.
IDENTITY = ("shape", "normalisation", "strategy", "position_optimizer", "alternation", "skew_map")

# 3DGS, code: learning rates (opacity 0.025 since October 2024), and the loss 0.8 L1 + 0.2 (1 - SSIM).
_RATES = {
    "position_lr_init": 1.6e-4,
    "position_lr_final": 1.6e-6,
    "feature_lr": 2.5e-3,
    "feature_rest_lr": None,
    "lr_factor": 1.0,
    "opacity_lr": 0.05,
    "scaling_lr": 5e-3,
    "rotation_lr": 1e-3,
    "lambda_dssim": 0.2,
    "smooth_l1": 0.0,
    "bisect_reg": 0.0,
    "average_last": 0.0,
    "random_points": 0.0,
    "dropout": 0.0,
    "depth_smoothness": 0.0,
    "occluder_check": False,
    "outlier_check": False,
    "visible_adam": False,
    "cut_background": False,
    "random_background": False,
    "antialiased": False,
    "turnover": 0.0,
    "split": "published",
}
# 3DGS, code: densification every 100 iterations from 500 to 15 000 of 30 000, opacity reset every 3000 iterations.
_CLONE_AND_SPLIT = {
    "strategy": "adc",
    "densify_from": 500 / 30_000,
    "densify_until": 15_000 / 30_000,
    "densify_interval": 100,
    "grad_threshold": 2e-4,
    "depth_threshold": 0.0,
    "dense_size": 0.01,
    "opacity_reset": 10,
    "init_opacity": 0.1,
    "init_scale": 1.0,
    "opacity_reg": 0.0,
    "scale_reg": 0.0,
    "noise_lr": 0.0,
}
# 3DGS-MCMC, code: densification every 100 iterations from 500 to 25 000 of 30 000.
_RELOCATE = {
    "strategy": "mcmc",
    "densify_from": 500 / 30_000,
    "densify_until": 25_000 / 30_000,
    "densify_interval": 100,
    "growth": 1.05,
    "relocation": "length",
    "relocation_limit": 1.0,
    "init_opacity": 0.5,
    "init_scale": 0.1,
    "opacity_reg": 0.01,
    "scale_reg": 0.01,
    "noise_lr": 5e5,
}
_ADAM = {"position_optimizer": "adam", "alternation": "off"}
# SSS, code: constants of SGHMC, as fractions of 30 000 iterations.
_SGHMC = {
    "sghmc_friction": 120.0,
    "sghmc_burn_in": 7000 / 30_000,
    "sghmc_burn_in_friction": 5e5,
    "noise_lr": 0.0,
}


def _gaussian_splatting() -> Values:
    """3DGS (Kerbl et al., SIGGRAPH 2023), code.

    The scene extent multiplies the position rate. Colour bands above the constant have a twentieth of the colour rate.
    Regularisers and noise are off. The first opacity is 0.1, the first scale the distance to three neighbours.
    A splat densifies if its mean gradient is above 2e-4: it is cloned below 0.01 of the extent, and split above.

    Not included: the opacity reset at iteration 500 over a white background, and the removal of large splats (reasons
    in density/adc.py).
    """
    return {"shape": "gaussian"} | _ADAM | _RATES | _CLONE_AND_SPLIT


def _generalised_exponential() -> Values:
    """GES (Hamdi et al., CVPR 2024), code: 3DGS with 40 000 iterations, threshold 3e-4, and beta as a factor of scale.

    The kernel is the released one, which only scales the Gaussian; `generalised-exponential` is the paper's. The rate
    of beta is 1e-3. Here it is the rate of log beta, so 1e-3 / 2 at the Gaussian's beta = 2. Densification ends at
    15 000 of 40 000 iterations; opacities are reset every 3000.

    Not included: the L1 loss with a mask from a difference of Gaussians (weight 0.5), the reset of beta every 1000
    iterations, and the removal of splats that beta has shrunk below 0.005.
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
    """3D-HGS (Li et al., CVPR 2025), code: 3DGS with two opacities for each splat, divided by a plane.

    The rate of the normal is 3e-3 (paper: 0.3 for Deep Blending). Densification ends at 20 000 of 30 000 iterations.
    The plane is projected exactly, not by the approximation of the release.

    Not included: the division of the opacity rate by 1.4 every 5000 iterations, and the common first normal
    (0.6, 0.6, 0.6). Here each splat starts with a random normal.
    """
    return _gaussian_splatting() | {"shape": "half-gaussian", "normal_lr": 3e-3, "densify_until": 20_000 / 30_000}


def _mcmc() -> Values:
    """3DGS-MCMC (Kheradmand et al., NeurIPS 2024), paper and code.

    Learning rates are those of 3DGS. The regularisers of opacity and scale have weight 0.01 each (opacity 0.001 for
    drjohnson), the noise is 5e5 times the position rate. The first opacity is 0.5, the first scale a tenth of the
    distance to the neighbours. Each step relocates all dead splats, with the Gaussian's coefficient for opacity and
    scale, and adds 5 % of the splats.
    """
    return {"shape": "gaussian"} | _ADAM | _RATES | _RELOCATE


def _student_t() -> Values:
    """SSS (Zhu et al., CVPR 2025), code: Student's t, signed opacities, recycling, SGHMC for positions.

    The opacity rate is 5e-3. The regularisers have weight 0.01 each (opacity 0.005 for Deep Blending). The first
    opacity is 0.5, the first scale a tenth of the distance to the neighbours.

    SGHMC has the published form: C = 120 (100 for Deep Blending) after a burn-in of 7000 iterations with C = 5e5.
    Bicycle and stump use a burn-in of 15 000 iterations with 5e8. Times are fractions of 30 000 iterations, over which
    the rate decays, though most scenes ran for 40 000. Each step relocates at most 5 % of the splats and adds 5 %. The
    scale changes by the square of the coefficient.

    In the release, nu starts at 100 and its rate is 10, halved every 5000 iterations. Here log nu has the constant rate
    0.033, the mean of 10 / 100 and its halves. Two things differ from the release: the derivative by nu is the correct
    one, and the low-pass of 0.3 px^2 stays on.
    """
    return (
        _mcmc()
        | _SGHMC
        | {
            "shape": "student-t",
            "position_optimizer": "sghmc-sss",
            "opacity_lr": 5e-3,
            "nu_lr": 0.033,
            "relocation": "length-squared",
            "relocation_limit": 0.05,
        }
    )


def _skew_normal() -> Values:
    """SNS (Wu et al. 2026), paper: the skew-normal about its location, unnormalised, SGHMC and alternating blocks.

    The kernel is exp times Phi without a factor. The skew is a bounded magnitude and a free direction. SGHMC trains the
    positions, and Adam all other parameters. The skew and all other parameters learn together at first, and then in
    turns. Regularisers are off.

    Not published, and chosen here:

    - The rate of the skew is 1.25e-2, which is 5 times the rate of the centred form, after trials in 2D. The bound is
      10.
    - Warm-up, cycle and split of the alternation are clsplat's defaults.
    - The first opacity is 0.5, the first scale half the distance to the neighbours.
    - SGHMC has the constants of SSS, in the stable form.
    - The strategy is the relocation of SSS without its square. The paper's training times and baselines suggest that
      SNS builds on the code of SSS.
    - All other rates are those of 3DGS.
    """
    return (
        _RATES
        | {
            "shape": "skew-normal-direct",
            "normalisation": "none",
            "skew_map": "polar",
            "skew_lr": 1.25e-2,
            "strategy": "mcmc",
            "relocation": "length",
            "relocation_limit": 0.05,
            "growth": 1.05,
            "init_opacity": 0.5,
            "init_scale": 0.5,
            "position_optimizer": "sghmc",
            "alternation": "cyclic",
            "opacity_reg": 0.0,
            "scale_reg": 0.0,
            "densify_from": 500 / 30_000,
            "densify_until": 25_000 / 30_000,
            "densify_interval": 100,
        }
        | _SGHMC
    )


def _bisected_skew() -> Values:
    """3DSGS (Zhao et al. 2026), paper: 3DGS with a skew, two opacities for each splat, and depth-aware densification.

    A splat is split if the gradient of its screen position or the one along the ray is above its threshold. A
    regulariser acts on the pair of opacities.

    Not published, and chosen here:

    - The threshold of the depth gradient times the scene extent is 1e-5. About the same number of splats exceeds it and
      the first threshold.
    - The weight of the regulariser is 0.001, as for clsplat's other regularisers.
    - The rate of the skew is 1.25e-2, as for SNS. All other rates and the first threshold are those of 3DGS.
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
    """Return the options of a published system by their names in `TrainConfig`.

    Raises
    ------
    InputError : an unknown preset.
    """
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}: choose one of {', '.join(PRESETS)}")
    return PRESETS[name]()


def with_preset(name: str, options: Mapping[str, Any]) -> Values:
    """Return the options of a preset, with some of them replaced.

    Parameters
    ----------
    options : values that replace those of the preset, such as the flags of a command line.

    Raises
    ------
    InputError : an unknown preset, or a value contradicts what makes the system (IDENTITY).
    """
    values = preset(name)
    for key in IDENTITY:
        if key in values and options.get(key, values[key]) != values[key]:
            raise InputError(
                f"preset {name} has {key} {values[key]}, which contradicts {key} {options[key]}: remove one of the two"
            )
    return values | dict(options)
