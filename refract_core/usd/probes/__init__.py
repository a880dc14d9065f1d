"""Reflection probes as records, with their pictures, and bakes written down beside them. Takes no picture."""

__all__ = ["pictures", "read"]
