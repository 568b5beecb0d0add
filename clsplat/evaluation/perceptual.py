"""Metrics of other packages: LPIPS (lpips, with PyTorch) and FLIP (flip-evaluator). The only module that imports them.

Both compare images rounded to 8 bits. Where a mask hides pixels, the photo's stand in for the render's, so that nothing
differs there.
"""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, reason_of

Image = NDArray[np.floating[Any]] | NDArray[np.uint8]
Mask = NDArray[np.bool_]

# The trunk that torchvision fetches for the net "vgg" (its IMAGENET1K_V1); lpips brings what lies on top of it.
VGG_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
VGG_MEGABYTES = 528
_line = partial(reason_of, max_length=160)
_LEAST = 32  # px, of VGG's five halvings


class Lpips:
    """LPIPS 0.1 (Zhang et al. 2018) with VGG16, as papers on splatting report it; 0 for equal images, less is better.

    Parameters
    ----------
    unit_range : images go into the net in 0..1, as 3DGS's script has it, not in the -1..1 that the net was made for.

    Raises
    ------
    InputError : the package or its weights cannot be had; says which, and where to put them.
    """

    def __init__(self, unit_range: bool = False) -> None:
        self.unit_range = unit_range
        try:
            import lpips
            import torch
        except ImportError as error:
            raise InputError(
                f"LPIPS needs the package lpips, with PyTorch and torchvision ({_line(error)}): "
                "pip install 'clsplat[lpips]'"
            ) from None
        except Exception as error:  # of torch and torchvision builds that do not belong together
            raise InputError(
                f"LPIPS: the package lpips cannot be loaded ({_line(error)}): install versions of torch "
                "and torchvision that belong together"
            ) from None
        self._torch = torch
        weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG_URL.rpartition("/")[2]
        was_there = weights.is_file()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # lpips calls torchvision by an old name
                self._net = lpips.LPIPS(net="vgg", verbose=False)
        except Exception as error:  # of the network, the disk, or a damaged file
            if was_there:
                raise InputError(
                    f"{weights}: LPIPS's weights cannot be read ({_line(error)}): delete the file, and "
                    "they are fetched again"
                ) from None
            raise InputError(
                f"LPIPS: the weights of VGG16 ({VGG_MEGABYTES} MB) cannot be fetched ({_line(error)}): "
                f"download {VGG_URL} elsewhere and put it into {weights.parent}"
            ) from None

    def __call__(self, render: Image, photo: Image, mask: Mask | None = None) -> float:
        """Distance of two images (H, W, 3), bytes or reals in 0..1.

        Raises
        ------
        InputError : an image below 32 px.
        """
        if min(photo.shape[:2]) < _LEAST:
            raise InputError(
                f"LPIPS: an image of {photo.shape[1]}x{photo.shape[0]} px; the net needs {_LEAST} at least"
            )
        a, b = (self._tensor(image) for image in _pair(render, photo, mask))
        with self._torch.inference_mode():
            return float(self._net(a, b))

    def describe(self) -> str:
        """What to write beside the numbers."""
        return f"lpips 0.1, net vgg, inputs {'0..1' if self.unit_range else '-1..1'}, rounded to 8 bits"

    def _tensor(self, image: NDArray[np.float32]) -> Any:
        planes = np.ascontiguousarray(image.transpose(2, 0, 1)[None])
        return self._torch.from_numpy(planes if self.unit_range else 2.0 * planes - 1.0)


class Flip:
    """LDR-FLIP (Andersson et al. 2020), at 67 pixels a degree; 0 for equal images, 1 at most.

    Raises
    ------
    InputError : the package is not installed.
    """

    def __init__(self) -> None:
        try:
            import flip_evaluator
        except ImportError as error:
            raise InputError(
                f"FLIP needs the package flip-evaluator ({_line(error)}): pip install 'clsplat[flip]'"
            ) from None
        self._evaluate = flip_evaluator.evaluate

    def __call__(self, render: Image, photo: Image, mask: Mask | None = None) -> NDArray[np.float32]:
        """(H, W) map of two images (H, W, 3), bytes or reals in 0..1."""
        a, b = _pair(render, photo, mask)
        found = np.asarray(self._evaluate(b, a, "LDR", applyMagma=False, computeMeanError=False)[0], np.float32)
        return found.reshape(found.shape[:2])

    @staticmethod
    def mean(found: NDArray[np.float32], mask: Mask | None = None) -> float:
        """Of a map, over the pixels that count."""
        return float(np.mean(found if mask is None else found[mask], dtype=np.float64))

    @staticmethod
    def describe() -> str:
        """What to write beside the numbers."""
        return "LDR-FLIP, mean of the map, 67 pixels a degree, rounded to 8 bits"


def _pair(render: Image, photo: Image, mask: Mask | None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    a, b = _unit(render), _unit(photo)
    return (a if mask is None else np.where(mask[..., None], a, b)), b


def _unit(image: Image) -> NDArray[np.float32]:
    """In 0..1 and steps of 8 bits."""
    steps = image if image.dtype == np.uint8 else np.rint(np.clip(image, 0.0, 1.0) * 255.0)
    return np.ascontiguousarray(steps, np.float32) / np.float32(255)
