"""Picture files, cubemaps and AOVs, in and out: the only wing that knows OpenImageIO."""

__all__ = ["aovs", "codec", "cubemaps", "frame", "layouts", "pictures", "srgb"]
