"""The page that `clsplat eval` writes."""
