"""Forms of the arithmetic of pixels and colours: speed against accuracy (cl/math/approx.clh)."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import InputError

# By their numbers in cl/math/approx.clh. Errors are absolute for Phi and relative for exp, in float32 vectors.
EXP_FORMS = ("polynomial", "builtin", "cubic", "power")  # 3.2e-7; the driver's; 7.5e-5; (1 + x/256)^256
PHI_FORMS = ("polynomial", "erfc", "logistic-cubic", "tanh", "logistic")  # 2.7e-7; the driver's; 1.4e-4; 1.8e-4; 9.5e-3


@dataclass(frozen=True)
class Arithmetic:
    """Forms of the pixel formulas, and how colour is kept on the device.

    Parameters
    ----------
    exp, phi : one of EXP_FORMS, PHI_FORMS. With one lane, and in double, "polynomial" and "cubic" are the exact ones.
    half_sh : spherical harmonics in half precision on the device: half of their memory, for rendering only.

    Raises
    ------
    InputError : no such form.
    """

    exp: str = EXP_FORMS[0]
    phi: str = PHI_FORMS[0]
    half_sh: bool = False

    def __post_init__(self) -> None:
        for name, form, forms in (("exp", self.exp, EXP_FORMS), ("phi", self.phi, PHI_FORMS)):
            if form not in forms:
                raise InputError(f"{name} {form!r}: choose one of {', '.join(forms)}")

    def defines(self) -> dict[str, int | float]:
        """Build constants."""
        return {
            "EXP_FORM": EXP_FORMS.index(self.exp),
            "PHI_FORM": PHI_FORMS.index(self.phi),
            "SH_HALF": int(self.half_sh),
        }


DEFAULT_ARITHMETIC = Arithmetic()
