"""The version, in its only place: setuptools reads this text, and modules read it without importing the package."""

__version__ = "0.1.0"
