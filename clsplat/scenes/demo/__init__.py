"""A made-up scene with known ground truth."""
