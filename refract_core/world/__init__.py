"""The packed scene that rays meet: Embree, tables of geometry and materials, textures, lights, the sky, and the light
that leaves an opaque hit. And what closed meshes enclose.
"""

__all__ = [
    "bounced", "caustics", "embree", "emitters", "environment", "gathering", "glow", "instances", "lamps", "lights",
    "offsets", "shading", "shaping", "solid", "surface", "tables", "textures", "tracing",
]  # fmt: skip
