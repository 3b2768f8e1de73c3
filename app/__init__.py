"""Reins: runtime governance for embodied agents."""

__version__ = "0.1.0"
