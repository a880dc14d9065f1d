"""Layers: asset paths, packages, thin layers over a stage, and their way to disk."""

__all__ = ["assets", "write"]
