"""What one does with a trained model: load, render, evaluate, convert, prune and export it."""
