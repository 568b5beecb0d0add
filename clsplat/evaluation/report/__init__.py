"""The report that `clsplat eval` writes."""
