"""Glass of a stage whose thickness can be measured, and the measured thickness written over it. Casts no ray."""

__all__ = ["find", "write"]
