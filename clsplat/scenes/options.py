"""Choices of `load_scene` that the command line offers before any image library is loaded."""

ALPHA_USES = ("background", "mask")  # transparency: composite over the background, or leave the pixels out
# Arguments of `load_scene`, besides the path and the background, that a run records to read its scene again.
READING_OPTIONS = ("images", "resolution", "masks", "alpha", "test_every", "test_list", "eval")
CAMERA_FORMATS = ("transforms", "colmap", "colmap-text", "cameras")  # what `clsplat cameras` writes
