"""Choices of scene functions that the command line offers. This module loads no image library."""

from collections.abc import Mapping
from typing import Any

# Transparent pixels are composited over the background, or are masked out, or count as if they were opaque.
ALPHA_USES = ("background", "mask", "ignore")

# Arguments of `load_scene`, besides the path and the background, that a run records to read its scene again.
READING_OPTIONS = ("images", "resolution", "masks", "alpha", "test_every", "test_list", "eval", "origin", "bars", "rim")
# Arguments that runs of earlier versions do not record: what these versions did.
BEFORE: Mapping[str, Any] = {"alpha": ALPHA_USES[0], "bars": [0.0, 0.0, 0.0, 0.0], "rim": False}
TEST_EVERY = 8  # every 8th view of the sorted names is a test view (Barron et al. 2022), as in 3DGS
ORIGIN = (0.0, 0.0, 0.0)  # of the coordinates of a scene's files
VIEW_SETS = ("test", "train", "validation", "all")  # sets of views that commands render or measure
CAMERA_FORMATS = ("transforms", "colmap", "colmap-text", "cameras")  # formats that `clsplat cameras` writes
