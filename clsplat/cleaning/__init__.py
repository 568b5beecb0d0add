"""Removal of floaters, oversized splats and splats that no training view sees."""
