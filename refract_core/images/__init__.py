"""Picture files, cubemaps and AOVs, in and out: the only wing that knows OpenImageIO."""

__all__ = ["aovs", "bake_files", "cubemap_files", "cubemaps", "files", "frame", "pictures", "srgb"]
