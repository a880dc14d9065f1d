"""Microfacet reflection: GGX, its visible-normal sampling, and the fit of its integral over the hemisphere.

`alpha` is the GGX width, the square of the authored (perceptual) roughness.
"""

from __future__ import annotations

import math

from .kernel import inlined
from .vec import add, cross, dot, frame, normalize, scale

MIRROR_ALPHA = 1e-3
"""Below this width a lobe is treated as a perfect mirror."""


@inlined
def ggx(n_dot_h, alpha):  # type: ignore[no-untyped-def]
    """Normal distribution D (Walter et al. 2007, eq. 33)."""
    a2 = alpha * alpha
    d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0
    return a2 / (math.pi * d * d)


@inlined
def smith_visibility(n_dot_v, n_dot_l, alpha):  # type: ignore[no-untyped-def]
    """G2 / (4 n.v n.l), height-correlated (Heitz 2014, eq. 99)."""
    a2 = alpha * alpha
    v = n_dot_l * math.sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2)
    l = n_dot_v * math.sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2)  # noqa: E741
    return 0.5 / max(v + l, 1e-9)


@inlined
def smith_g1(n_dot_x, alpha):  # type: ignore[no-untyped-def]
    a2 = alpha * alpha
    return 2.0 * n_dot_x / max(n_dot_x + math.sqrt(a2 + (1.0 - a2) * n_dot_x * n_dot_x), 1e-9)


@inlined
def sample_half_vector(n, wo, alpha, u1, u2):  # type: ignore[no-untyped-def]
    """A microfacet normal among those visible from `wo` (Heitz, JCGT 7(4) 2018)."""
    x, y = frame(n)
    v = normalize((alpha * dot(wo, x), alpha * dot(wo, y), dot(wo, n)))
    squared = v[0] * v[0] + v[1] * v[1]
    if squared > 0.0:
        s = 1.0 / math.sqrt(squared)
        t1 = (-v[1] * s, v[0] * s, 0.0)
    else:
        t1 = (1.0, 0.0, 0.0)
    t2 = cross(v, t1)
    r = math.sqrt(u1)
    phi = 2.0 * math.pi * u2
    p1 = r * math.cos(phi)
    s = 0.5 * (1.0 + v[2])
    p2 = (1.0 - s) * math.sqrt(max(0.0, 1.0 - p1 * p1)) + s * r * math.sin(phi)
    p3 = math.sqrt(max(0.0, 1.0 - p1 * p1 - p2 * p2))
    h = add(add(scale(t1, p1), scale(t2, p2)), scale(v, p3))
    h = normalize((alpha * h[0], alpha * h[1], max(1e-6, h[2])))
    return normalize(add(add(scale(x, h[0]), scale(y, h[1])), scale(n, h[2])))


@inlined
def directional_albedo(n_dot_v, roughness):  # type: ignore[no-untyped-def]
    """(A, B) with reflectance = F0 * A + B: the split-sum integral of GGX as fitted by B. Karis,
    "Physically Based Shading on Mobile" (2014)."""
    r0 = -1.0 * roughness + 1.0
    r1 = -0.0275 * roughness + 0.0425
    r2 = -0.572 * roughness + 1.04
    r3 = 0.022 * roughness - 0.04
    a004 = min(r0 * r0, 2.0 ** (-9.28 * n_dot_v)) * r0 + r1
    return -1.04 * a004 + r2, 1.04 * a004 + r3
