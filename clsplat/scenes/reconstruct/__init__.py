"""Photographs or a video to a scene."""
