"""Densification: splats that are added, moved and removed."""
