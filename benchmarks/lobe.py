"""What a rough slab of glass does to light, by Monte Carlo: the outside number the tiers' blur is held against.

Nothing of the engine is in here. Microfacets are GGX with Smith masking, refraction is Walter et al., "Microfacet
Models for Refraction through Rough Surfaces" (2007), half vectors are drawn from those that are seen (Heitz, "Sampling
the GGX Distribution of Visible Normals", JCGT 2018), and every ray bends by Snell's law at both faces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class Light(NamedTuple):
    """Rays after an interface; z is the normal on the side they came from."""

    direction: F64
    """shape (N, 3), unit, travelling to -z"""
    weight: F64
    """shape (N,): share of the light that a ray carries, 0 .. 1"""


def visible_normals(v: F64, alpha: float, u: F64) -> F64:
    """Microfacet normals as often as `v` sees them (Heitz 2018).

    Args:
        v: shape (N, 3), unit, towards where the light comes from, z > 0.
        alpha: GGX roughness, > 0.
        u: shape (2, N), 0 .. 1.
    """
    stretched = _unit(v * (alpha, alpha, 1.0))
    flat = np.hypot(stretched[:, 0], stretched[:, 1])
    upright = flat < 1e-12
    safe = np.where(upright, 1.0, flat)
    t1 = np.stack([np.where(upright, 1.0, -stretched[:, 1] / safe), np.where(upright, 0.0, stretched[:, 0] / safe),
                   np.zeros_like(flat)], 1)  # fmt: skip
    t2 = np.cross(stretched, t1)
    radius, phi = np.sqrt(u[0]), 2.0 * np.pi * u[1]
    a, b = radius * np.cos(phi), radius * np.sin(phi)
    s = 0.5 * (1.0 + stretched[:, 2])
    b = (1.0 - s) * np.sqrt(np.maximum(0.0, 1.0 - a * a)) + s * b
    c = np.sqrt(np.maximum(0.0, 1.0 - a * a - b * b))
    n = a[:, None] * t1 + b[:, None] * t2 + c[:, None] * stretched
    return _unit(np.stack([alpha * n[:, 0], alpha * n[:, 1], np.maximum(n[:, 2], 1e-12)], 1))


def through_interface(light: Light, alpha: float, eta_i_over_t: float, u: F64) -> Light:
    """One rough interface: Snell at the microfacet, less what it reflects (Fresnel) and what others mask (Smith)."""
    v = -light.direction
    h = visible_normals(v, alpha, u)
    c = np.sum(v * h, 1)
    k = 1.0 - eta_i_over_t**2 * (1.0 - c * c)
    cos_t = np.sqrt(np.maximum(k, 0.0))
    out = -eta_i_over_t * v + (eta_i_over_t * c - cos_t)[:, None] * h
    rs = (eta_i_over_t * c - cos_t) / (eta_i_over_t * c + cos_t)
    rp = (c - eta_i_over_t * cos_t) / (c + eta_i_over_t * cos_t)
    share = 1.0 - 0.5 * (rs * rs + rp * rp)
    alive = (k > 0.0) & (c > 0.0) & (out[:, 2] < 0.0)
    out[~alive] = (0.0, 0.0, -1.0)
    return Light(out, np.where(alive, light.weight * share * _masking(out, alpha), 0.0))


def _masking(d: F64, alpha: float) -> F64:
    """Smith's G1 of GGX (Walter et al. 2007, equation 34)."""
    squared = (d[:, 0] ** 2 + d[:, 1] ** 2) / d[:, 2] ** 2
    return 2.0 / (1.0 + np.sqrt(1.0 + alpha * alpha * squared))


def _unit(v: F64) -> F64:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def straight(count: int) -> Light:
    """Rays that look straight at the glass."""
    return Light(np.tile([0.0, 0.0, -1.0], (count, 1)), np.ones(count))


def slab(roughness: float, ior: float, count: int, seed: int = 1) -> tuple[Light, Light]:
    """Rays that looked straight at a slab, inside it and behind it. `roughness` is perceptual: alpha is its square."""
    u = np.random.default_rng(seed).random((4, count))
    alpha = roughness * roughness
    inside = through_interface(straight(count), alpha, 1.0 / ior, u[:2])
    return inside, through_interface(inside, alpha, ior, u[2:])


def slopes(light: Light) -> F64:
    """shape (N, 2): x and y that a ray gains per length it goes down."""
    return light.direction[:, :2] / -light.direction[:, 2:]


def weighted_median(values: F64, weights: F64) -> float:
    """The value below which half of the weight lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(np.interp(0.5 * total[-1], total, values[order]))


def median_slope(light: Light) -> float:
    """Tangent of the half angle of the cone that holds half of the light."""
    return weighted_median(np.hypot(*slopes(light).T), light.weight)


def edge_half_width(roughness: float, ior: float, thickness: float, distance: float, count: int) -> float:
    """Half of the way from 25 % to 75 % across the picture of an edge behind a rough slab [m].

    An edge's profile is the distribution of where rays arrive along one axis, and that is symmetric.
    """
    inside, behind = slab(roughness, ior, count)
    arrived = slopes(inside) * thickness + slopes(behind) * distance
    return weighted_median(np.abs(arrived).ravel(), np.repeat(behind.weight, 2))
