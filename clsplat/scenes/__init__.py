"""Scenes: photos with camera poses and points."""
