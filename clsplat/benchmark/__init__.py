"""Published benchmarks: their sets, protocols and figures, and their runs."""
