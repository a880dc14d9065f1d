"""Light through glass: a tree of rays for every pixel that sees some, and the tiers that answer where it ends."""

__all__ = ["corners", "crossing", "eye", "pixels", "rays", "tiers", "tree"]
