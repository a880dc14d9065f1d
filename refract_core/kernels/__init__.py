"""How per-pixel code is compiled, cached and handed its records; vectors, samples and lanes. Knows no physics."""

__all__ = ["choice", "compile", "lanes", "pointer", "sampling", "vec"]
