"""The smallest model that a scene needs."""
