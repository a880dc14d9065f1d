"""Light through glass: where a ray leaves it, which tier answers there, and how a layer of it is drawn."""

__all__ = ["layers", "tiers"]
