"""The packed scene that rays meet: Embree, tables of geometry and materials, textures, lights, the sky, and the light
that leaves an opaque hit.
"""

__all__ = ["embree", "environment", "lights", "offsets", "shading", "surface", "tables", "textures", "tracing"]
