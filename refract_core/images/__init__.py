"""Picture files, cubemaps and AOVs, in and out: the only wing that knows OpenImageIO. Knows no scene of the engine
but its records.
"""

__all__ = [
    "animation", "aovs", "codec", "cryptomatte", "cubemaps", "denoise", "exr", "frame", "joining", "layouts",
    "pictures", "shown", "spaces", "srgb",
]  # fmt: skip
