"""Picture files, cubemaps and AOVs, in and out: the only wing that knows OpenImageIO. Knows no scene of the engine
but its records.
"""

__all__ = ["aovs", "codec", "cubemaps", "frame", "layouts", "pictures", "spaces", "srgb"]
