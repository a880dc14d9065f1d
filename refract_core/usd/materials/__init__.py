"""Surface shaders of every dialect, read as rows of the material table."""

__all__ = ["glass", "read", "sources", "surfaces", "textures", "vendors"]
