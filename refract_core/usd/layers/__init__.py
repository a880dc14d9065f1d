"""Layers: asset paths, packages, thin layers over a stage, and their way to disk. Knows none of our schemas."""

__all__ = ["assets", "mtlx", "write"]
