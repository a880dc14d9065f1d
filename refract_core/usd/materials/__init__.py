"""Surface shaders of every dialect, read as rows of the material table. Knows no geometry."""

__all__ = ["nodes", "read", "sources", "surfaces", "textures", "udim", "vendors"]
