"""A second opinion on one pixel: plain Python in double precision, one ray at a time, against which the engine is held.

It shares nothing with the engine but its records, its enums, and the table of the fitted reflectance. It reads as the
engine's promises do, room by room: `vec`, `sampling`, `textures`, `world` (what a ray meets), `surface` (what is
there), `sky`, `lights`, `shading` (light from opaque surfaces), `optics` (Snell, Fresnel, Beer-Lambert, the closed
models: what an interface does), `media` (what a ray is in), `tree` (where rays go on), `tiers` (who answers a ray that
ended) and `picture` (the pixel). It is slow: milliseconds a pixel, in scenes of some dozens of triangles.
"""

from .picture import Oracle, Pixel

__all__ = ["Oracle", "Pixel"]
