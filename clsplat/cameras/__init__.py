"""Pinhole cameras and camera paths."""
