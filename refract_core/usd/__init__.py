"""The only wing that knows USD: stages in, plain arrays out, and layers written over them. Draws nothing."""

__all__ = [
    "convert",
    "diagnostics",
    "layers",
    "materials",
    "opening",
    "prim_count",
    "probes",
    "products",
    "registering",
    "rules",
    "settings",
    "stage",
    "thickness",
    "time_codes",
    "values",
]
