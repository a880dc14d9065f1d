"""Prims with a surface as triangles at their places in engine world."""

__all__ = ["gprims", "parts", "place", "primvars", "shapes", "skel", "traverse", "triangulate"]
