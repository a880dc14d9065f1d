"""Light through glass: a tree of rays for every pixel that sees some, the tiers that answer where it ends, and photons
that go the other way."""

__all__ = [
    "behind", "between", "corners", "crossing", "edges", "eye", "features", "patch", "photons", "pixels", "rays",
    "tiers", "tree",
]  # fmt: skip
