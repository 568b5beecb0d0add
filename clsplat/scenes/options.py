"""Choices of `load_scene` that the command line offers before any image library is loaded."""

ALPHA_USES = ("background", "mask")  # transparency: composite over the background, or leave the pixels out
CAMERA_FORMATS = ("transforms", "colmap", "colmap-text", "cameras")  # what `clsplat cameras` writes
