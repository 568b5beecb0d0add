"""Trained models: load, render, measure, convert, prune."""
