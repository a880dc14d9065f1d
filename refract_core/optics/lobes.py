"""Microfacet reflection: GGX, its visible-normal sampling, and the fit of its integral over the hemisphere.

`alpha` is the GGX width, the square of the authored (perceptual) roughness.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.vec import Vec, add, cross, dot, frame, normalize, scale

MIRROR_ALPHA = 1e-3
"""Below this width a lobe is treated as a perfect mirror."""

# Integral of GGX over the hemisphere, split as F0 * A + B (Karis 2013), from 90 000 visible normals per entry (Heitz
# 2018). Rows: roughness 0 .. 1 by 1/8; columns: sqrt(n.v) 0 .. 1 by 1/8. Linear between: within 0.026, mean 0.002.
_ALBEDO_A = (
    (0.005, 0.076, 0.276, 0.531, 0.763, 0.916, 0.984, 0.999, 1.000),
    (0.213, 0.177, 0.301, 0.538, 0.763, 0.915, 0.984, 0.999, 1.000),
    (0.488, 0.463, 0.457, 0.577, 0.758, 0.902, 0.973, 0.993, 0.996),
    (0.685, 0.670, 0.648, 0.668, 0.751, 0.857, 0.931, 0.964, 0.976),
    (0.806, 0.790, 0.763, 0.747, 0.759, 0.801, 0.852, 0.891, 0.916),
    (0.875, 0.854, 0.815, 0.778, 0.752, 0.745, 0.753, 0.772, 0.796),
    (0.913, 0.884, 0.827, 0.769, 0.717, 0.675, 0.646, 0.631, 0.627),
    (0.934, 0.894, 0.817, 0.735, 0.658, 0.590, 0.534, 0.488, 0.452),
    (0.946, 0.894, 0.793, 0.687, 0.587, 0.499, 0.423, 0.360, 0.307),
)
_ALBEDO_B = (
    (0.989, 0.924, 0.724, 0.469, 0.237, 0.084, 0.016, 0.001, 0.000),
    (0.774, 0.715, 0.664, 0.455, 0.235, 0.084, 0.016, 0.001, 0.000),
    (0.509, 0.487, 0.432, 0.342, 0.204, 0.081, 0.018, 0.001, 0.000),
    (0.313, 0.301, 0.264, 0.208, 0.137, 0.065, 0.018, 0.002, 0.000),
    (0.192, 0.183, 0.158, 0.122, 0.081, 0.042, 0.015, 0.002, 0.000),
    (0.122, 0.115, 0.096, 0.072, 0.047, 0.025, 0.010, 0.002, 0.000),
    (0.083, 0.076, 0.062, 0.044, 0.028, 0.015, 0.006, 0.001, 0.000),
    (0.060, 0.054, 0.042, 0.028, 0.017, 0.009, 0.004, 0.001, 0.000),
    (0.047, 0.041, 0.030, 0.019, 0.011, 0.005, 0.002, 0.001, 0.000),
)
_ALBEDO = np.array([_ALBEDO_A, _ALBEDO_B])


class Cone(NamedTuple):
    """A ray that stands for a rough lobe of rays: what asks the screen or a probe, whose pictures are filtered."""

    origin: Vec
    """[m]"""
    direction: Vec
    """unit, the lobe's axis"""
    blur: float
    """tangent of the half angle within which the lobe keeps half of its rays"""
    roughness: float
    """perceptual, for HDRP's own mappings of roughness to levels, which know no angle"""


@inlined
def sample_cosine(n: Vec, u1: float, u2: float) -> Vec:
    """A direction over `n`, by the cosine: its density is the cosine over pi [1/sr]. `u1`, `u2`: 0 .. 1."""
    x, y = frame(n)
    r = math.sqrt(u1)
    phi = 2.0 * math.pi * u2
    z = math.sqrt(max(0.0, 1.0 - u1))
    return add(add(scale(x, r * math.cos(phi)), scale(y, r * math.sin(phi))), scale(n, z))


@inlined
def ggx(n_dot_h: float, alpha: float) -> float:
    """Normal distribution D (Walter et al. 2007, eq. 33)."""
    a2 = alpha * alpha
    d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0
    return a2 / (math.pi * d * d)


@inlined
def smith_visibility(n_dot_v: float, n_dot_l: float, alpha: float) -> float:
    """G2 / (4 n.v n.l), height-correlated (Heitz 2014, eq. 99)."""
    # The cosines of the microfacet denominator are already divided out here: both vanish at grazing angles.
    a2 = alpha * alpha
    v = n_dot_l * math.sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2)
    l = n_dot_v * math.sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2)  # noqa: E741
    return 0.5 / max(v + l, 1e-9)


@inlined
def sample_half_vector(n: Vec, wo: Vec, alpha: float, u1: float, u2: float) -> Vec:
    """A microfacet normal among those visible from `wo` (Heitz, JCGT 7(4) 2018). `u1`, `u2`: a point of [0, 1)^2."""
    # Stretched by alpha, the ellipsoid of microfacets becomes the unit hemisphere, seen along v.
    x, y = frame(n)
    v = normalize((alpha * dot(wo, x), alpha * dot(wo, y), dot(wo, n)))
    squared = v[0] * v[0] + v[1] * v[1]
    if squared > 0.0:
        s = 1.0 / math.sqrt(squared)
        t1 = (-v[1] * s, v[0] * s, 0.0)
    else:
        t1 = (1.0, 0.0, 0.0)
    t2 = cross(v, t1)
    # What v sees of the hemisphere is a disk, half of it foreshortened: a point of that disk, then up to the sphere.
    r = math.sqrt(u1)
    phi = 2.0 * math.pi * u2
    p1 = r * math.cos(phi)
    s = 0.5 * (1.0 + v[2])
    p2 = (1.0 - s) * math.sqrt(max(0.0, 1.0 - p1 * p1)) + s * r * math.sin(phi)
    p3 = math.sqrt(max(0.0, 1.0 - p1 * p1 - p2 * p2))
    h = add(add(scale(t1, p1), scale(t2, p2)), scale(v, p3))
    # Back from the hemisphere to the ellipsoid: normals shrink where points were stretched.
    h = normalize((alpha * h[0], alpha * h[1], max(1e-6, h[2])))
    return normalize(add(add(scale(x, h[0]), scale(y, h[1])), scale(n, h[2])))


@inlined
def directional_albedo(n_dot_v: float, roughness: float) -> tuple[float, float]:
    """(A, B) with reflectance = F0 * A + B: the split-sum integral of single-scattering GGX. Perceptual roughness."""
    # Columns go by the root of the cosine, because all of the change is near grazing.
    y, x = 8.0 * min(1.0, max(0.0, roughness)), 8.0 * np.sqrt(min(1.0, max(0.0, n_dot_v)))
    j, i = min(7, int(y)), min(7, int(x))
    v, u = y - j, x - i
    a, b = _ALBEDO[0], _ALBEDO[1]
    top, bottom = 1.0 - v, v
    left, right = 1.0 - u, u
    return (
        top * (left * a[j, i] + right * a[j, i + 1]) + bottom * (left * a[j + 1, i] + right * a[j + 1, i + 1]),
        top * (left * b[j, i] + right * b[j, i + 1]) + bottom * (left * b[j + 1, i] + right * b[j + 1, i + 1]),
    )


@inlined
def specular_albedo(f0: Vec, roughness: float, n_dot_v: float) -> Vec:
    """Share of a uniform light that the lobe sends back, per channel. Its grazing value fades with an F0 below 2 %,
    so that a surface without any reflectance has no rim (Lagarde and de Rousiers 2014, section 3.1.2)."""
    a, b = directional_albedo(n_dot_v, roughness)
    edge = b * min(1.0, 50.0 * max(f0[0], f0[1], f0[2]))
    return (f0[0] * a + edge, f0[1] * a + edge, f0[2] * a + edge)
