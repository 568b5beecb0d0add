"""Splats to an image, and gradients back."""
