"""Cameras and points that photogrammetry programs export: OPF projects, and the cameras of Metashape."""
