"""UsdLux lights and domes as the light table and the environment. Knows no surface."""

__all__ = ["bodies", "meshes", "read"]
