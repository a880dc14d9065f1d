"""The physics of one ray at one interface, as free functions: Snell, Fresnel, the models, absorption, lobes.
Knows no scene.
"""

__all__ = ["arrays", "interface", "lobes", "models"]
