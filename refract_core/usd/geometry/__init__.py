"""Prims with a surface as triangles at their places in engine world. Knows no light and no camera."""

__all__ = [
    "cages", "curves", "dots", "many", "moving", "parts", "place", "primvars", "refined", "shapes", "skel",
    "standins", "traverse", "triangulate", "ways",
]  # fmt: skip
