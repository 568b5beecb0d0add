"""Metrics of other packages: LPIPS (lpips, with PyTorch) and FLIP (flip-evaluator).

This is the only module that imports them. Both compare images rounded to 8 bits. Hidden pixels of the render are
replaced by those of the photo, so that no difference is visible there.
"""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, reason_of
from ..files.masks import Mask

Image = NDArray[np.floating[Any]] | NDArray[np.uint8]

# Weights that torchvision downloads for the net "vgg" (its IMAGENET1K_V1); lpips itself contains the layers on top.
VGG_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
VGG_MEGABYTES = 528
_line = partial(reason_of, max_length=160)
MIN_SIZE = 32  # px: VGG halves the image five times


class Lpips:
    """LPIPS 0.1 (Zhang et al. 2018) with VGG16, as papers on splatting report it; 0 for equal images, lower is better.

    Parameters
    ----------
    unit_range : pass images to the net in 0..1, as 3DGS's script does. The net was made for -1..1.

    Raises
    ------
    InputError : the package is not installed, or its weights are missing; the message says where to put them.
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
        except Exception as error:  # torch and torchvision of different versions raise many kinds
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
        except Exception as error:  # the network, the disk or a damaged file
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
        """Return the distance of two images (H, W, 3), bytes or reals in 0..1.

        Raises
        ------
        InputError : an image is smaller than MIN_SIZE.
        """
        if min(photo.shape[:2]) < MIN_SIZE:
            raise InputError(
                f"LPIPS: an image of {photo.shape[1]}x{photo.shape[0]} px; the net needs {MIN_SIZE} at least"
            )
        a, b = (self._tensor(image) for image in _pair(render, photo, mask))
        with self._torch.inference_mode():
            return float(self._net(a, b))

    def describe(self) -> str:
        """Text on how the metric is computed."""
        return f"lpips 0.1, net vgg, inputs {'0..1' if self.unit_range else '-1..1'}, rounded to 8 bits"

    def _tensor(self, image: NDArray[np.float32]) -> Any:
        planes = np.ascontiguousarray(image.transpose(2, 0, 1)[None])
        return self._torch.from_numpy(planes if self.unit_range else 2.0 * planes - 1.0)


class Flip:
    """LDR-FLIP (Andersson et al. 2020) at 67 pixels a degree, from 0 for equal images to 1.

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
        """Return the (H, W) map of differences of two images (H, W, 3), bytes or reals in 0..1."""
        a, b = _pair(render, photo, mask)
        flip_map = np.asarray(self._evaluate(b, a, "LDR", applyMagma=False, computeMeanError=False)[0], np.float32)
        return flip_map.reshape(flip_map.shape[:2])

    @staticmethod
    def mean(flip_map: NDArray[np.float32], mask: Mask | None = None) -> float:
        """Mean of a map over the pixels that count."""
        return float(np.mean(flip_map if mask is None else flip_map[mask], dtype=np.float64))

    @staticmethod
    def describe() -> str:
        """Text on how the metric is computed."""
        return "LDR-FLIP, mean of the map, 67 pixels a degree, rounded to 8 bits"


def _pair(render: Image, photo: Image, mask: Mask | None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    a, b = _unit(render), _unit(photo)
    return (a if mask is None else np.where(mask[..., None], a, b)), b


def _unit(image: Image) -> NDArray[np.float32]:
    """The image in 0..1, in steps of 8 bits."""
    steps = image if image.dtype == np.uint8 else np.rint(np.clip(image, 0.0, 1.0) * 255.0)
    return np.ascontiguousarray(steps, np.float32) / np.float32(255)
