"""Finite-element mesh smoothing in JAX."""

__version__ = "0.1.0"
