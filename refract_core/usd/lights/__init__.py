"""UsdLux lights and domes as the light table and the environment."""

__all__ = ["domes", "read"]
