"""Coefficients of exp, log and Phi in cl/math/approx.clh have the documented error and are close to optimal."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "fit_polynomials.py"


def fits() -> tuple[Any, ...]:
    spec = importlib.util.spec_from_file_location("fit_polynomials", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return tuple(module.FITS)


@pytest.mark.parametrize("fit", fits(), ids=lambda fit: fit.name)
def test_the_source_has_the_stated_error(fit: Any) -> None:
    assert 0.9 * fit.stated < fit.error(fit.committed) <= fit.stated


@pytest.mark.parametrize("fit", fits(), ids=lambda fit: fit.name)
def test_the_fit_finds_the_coefficients_again(fit: Any) -> None:
    fitted = fit.fitted()
    assert fit.error(fitted) <= fit.error(fit.committed) < 2.1 * fit.error(fitted)
    for power, (best, committed) in enumerate(zip(fitted, fit.committed, strict=True)):
        assert committed == pytest.approx(best, rel=2e-3), power


def test_a_wrong_digit_is_noticed() -> None:
    fit = fits()[0]
    first, second, *others = fit.committed
    assert fit.error((first, second + 1e-6, *others)) > fit.stated
