"""Hazards for splat engines, by kind; benchmarks/stability.py runs them and judges."""
