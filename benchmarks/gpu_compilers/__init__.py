"""Offline compilers of GPUs: what registers, memory and occupancy the kernels need, without a GPU."""
