"""What a splat model is, on the host."""
