"""How per-pixel code is compiled, cached and handed its records; vectors, samples and lanes. Knows no physics."""

__all__ = ["ahead", "arrays", "build", "choice", "compile", "lanes", "pointer", "sampling", "store", "vec"]
