"""Scenes from photos or a video, by structure from motion."""
