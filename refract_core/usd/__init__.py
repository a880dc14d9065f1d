"""The only wing that knows USD: stages in, plain arrays out, and layers written over them. Draws nothing."""

__all__ = [
    "convert",
    "diagnostics",
    "layers",
    "materials",
    "prim_count",
    "probes",
    "registering",
    "rules",
    "settings",
    "stage",
    "thickness",
    "time_codes",
    "values",
]
