"""Which splats are added, moved and removed."""
