"""Reflection probes as records, with their pictures, and bakes written down beside them."""

__all__ = ["bakes", "pictures", "read", "values", "volumes"]
