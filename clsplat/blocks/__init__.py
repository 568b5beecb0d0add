"""Large scenes in blocks: a coarse model of all, a run for each block, and one model of them."""
