"""A demo scene with known ground truth, rendered without a data set."""
