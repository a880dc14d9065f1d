"""Surface shaders of every dialect, read as rows of the material table. Knows no geometry."""

__all__ = ["read", "sources", "surfaces", "textures", "vendors"]
