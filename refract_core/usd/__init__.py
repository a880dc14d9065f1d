"""The only wing that knows USD: stages in, plain arrays out, and layers written over them."""

__all__ = [
    "camera",
    "convert",
    "geometry",
    "layers",
    "lights",
    "materials",
    "ours",
    "probes",
    "registering",
    "rules",
    "settings",
    "stage",
    "thickness",
    "thickness_find",
    "time_codes",
]
