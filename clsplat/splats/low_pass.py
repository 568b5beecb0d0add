"""The low pass of a model: a variance that widens each splat in the image, so that none is thinner than a pixel.

It belongs to the model, because training sees all splats through it. A pixel is a square whose variance is 1/12 px²;
a wider low pass blurs the image.
"""

from __future__ import annotations

from .model_number import ModelNumber

LOW_PASS = 0.3  # px², as in 3DGS: of models that name none
PIXEL = 0.1  # px², as in Mip-Splatting (Yu et al., CVPR 2024, arXiv 2311.16493): of antialiased models from training
LOW_PASSES = ModelNumber("low_pass", LOW_PASS, "a variance above 0 [px²]")
