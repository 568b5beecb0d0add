"""Optimizers: Adam on the device and in NumPy, SGHMC, skew maps, regularisers and noise."""
