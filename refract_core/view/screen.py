"""The screen tier: what a ray would see, read from the opaque picture the camera already has.

`march` follows the ray through the depth pyramid and accepts a pixel only where the ray meets the plane of the surface
seen there. `traced` knows what the ray meets, and asks whether the picture shows that. `proxy` is HDRP's way: one guess
at a proxy volume, reprojected, with no test but "not in front".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, dot, row, scale, sub
from ..optics.lobes import Cone
from ..probes.volumes import edge_fade
from ..world.textures import Rgba
from .camera import PixelPoint, pixel_point, pixel_width, project
from .pyramid import Screen, color_at

SCREEN_FADE = 0.1
"""Screen Weight Distance (HDRP's default)."""
_MAX_STEPS = 384
_FACING = 1e-3  # cosine below which a surface is seen too edge-on to be hit
_BEHIND = 1.001  # ratio of depths beyond which a ray counts as behind a surface
_LEVEL_MEDIAN = 1.92
"""Median radius of the colour pyramid's blur, in pixels of a level. Its variance is 8/3 (4^level - 1) pixels^2, from a
binomial filter of 2 texels^2 on each level, and half of a round Gaussian lies within 1.177 deviations."""
_SAME = 0.02  # part of the way from eye to hit by which two pixels of one surface may disagree
_ALIKE = 0.9  # cosine between normals of what may be one surface
_COPLANAR = 0.002  # part of the depth by which a point may lie outside of a pixel's plane
_AGREE = 0.2  # part of the brightest light by which pixels may differ about what falls on a surface
_SLACK = 1.0  # how far outside its pixel a plane may be met, in pixels' worth of the ray


class ScreenHit(NamedTuple):
    """Where a ray meets a surface of the picture. It lives as long as one query."""

    found: bool
    x: float
    """pixel coordinate, continuous; so is y"""
    y: float
    distance: float
    """along the ray [m]"""


_NOTHING = (0.0, 0.0, 0.0, 0.0)


class SeenLight(NamedTuple):
    """What the picture knows of the light at a place."""

    known: bool
    x: float
    """pixel coordinate, continuous; so is y"""
    y: float
    z_depth: float
    """[m]"""
    irradiance: Vec
    gloss: Vec
    """highlights and what is mirrored, as the eye sees it"""
    lamps: float
    """share of their light that arrives, where that is known; so is the next, colour by colour"""
    sky: Vec


_DARK = SeenLight(False, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))


class ScreenLight(NamedTuple):
    """What the screen shows to one ray."""

    color: Rgba
    """radiance, premultiplied by coverage, and coverage: what is not covered there nobody has answered"""
    weight: float
    """0 .. 1"""
    confidence: float
    """0 .. 1: how surely it is what the ray would have met"""


@inlined
def _cross_distance(boundary: float, a: float, b: float, aw: float, bw: float) -> float:
    """Ray distance at which pixel coordinate (a + t b) / (aw + t bw) reaches `boundary`; inf if it never does."""
    denominator = b - boundary * bw
    if denominator == 0.0:
        return math.inf
    return (boundary * aw - a) / denominator


@inlined
def _plane_distance(screen: Screen, ix: int, iy: int, depth: float, origin: Vec, direction: Vec) -> float:
    """Ray distance to the plane of the surface seen in a pixel; -1 where the ray comes from behind or edge-on."""
    normal = row(screen.normal[iy], ix)
    facing = dot(direction, normal)
    if facing > -_FACING:
        return -1.0
    seen = pixel_point(screen.camera, ix + 0.5, iy + 0.5, depth)
    return dot(sub(seen, origin), normal) / facing


@inlined
def march(screen: Screen, origin: Vec, direction: Vec) -> ScreenHit:
    """First opaque surface of the picture that the ray meets.

    The ray is cut by the cells of the depth pyramid (Uludag, "Hi-Z Screen-Space Cone-Traced Reflections", GPU Pro 5,
    2014), in exact distances along the ray. A cell is skipped while the ray is nearer than everything in it.
    """
    view = screen.camera
    width, height = int(view.size[0]), int(view.size[1])
    # Homogeneous pixel coordinates, linear along the ray: (ax + t bx, ay + t by) / (aw + t bw). Stepping in them keeps
    # t the distance in metres, which steps in pixels would not.
    left, right, bottom, top = view.window[0], view.window[1], view.window[2], view.window[3]
    sx, sy = width / (right - left), height / (bottom - top)
    o = sub(origin, row(view.axes, 3))
    x_axis, y_axis, z_axis = row(view.axes, 0), row(view.axes, 1), row(view.axes, 2)
    z, dz = dot(o, z_axis), dot(direction, z_axis)
    aw, bw = (1.0, 0.0) if view.orthographic else (z, dz)
    ax, bx = (dot(o, x_axis) - left * aw) * sx, (dot(direction, x_axis) - left * bw) * sx
    ay, by = (dot(o, y_axis) - top * aw) * sy, (dot(direction, y_axis) - top * bw) * sy
    near = view.clipping[0]
    if z <= near:
        return ScreenHit(False, 0.0, 0.0, 0.0)
    # Beyond the near plane, towards the eye, there are no pixels.
    end = (near - z) / dz if dz < 0.0 else math.inf
    # The derivative of a quotient keeps its sign, so the ray crosses columns, and rows, in one direction only.
    step_x = 1 if bx * aw - ax * bw > 0.0 else -1
    step_y = 1 if by * aw - ay * bw > 0.0 else -1

    # State of the march.
    ix, iy = math.floor(ax / aw), math.floor(ay / aw)  # the pixel the ray is in
    t = 0.0  # distance at which it came into it [m]
    last = min(screen.depth_level.shape[0] - 1, 7)  # coarsest level used: a cell of 128 pixels
    level = min(2, last)  # of the cell that is asked
    for _ in range(_MAX_STEPS):
        if ix < 0 or iy < 0 or ix >= width or iy >= height or t >= end:
            break
        # The stretch of the ray in this cell: from t to the first of the two edges it heads for.
        cx, cy = ix >> level, iy >> level
        edge_x = (cx + 1 if step_x > 0 else cx) << level
        edge_y = (cy + 1 if step_y > 0 else cy) << level
        tx = _cross_distance(edge_x, ax, bx, aw, bw)
        ty = _cross_distance(edge_y, ay, by, aw, bw)
        # An edge just crossed may come out behind t by rounding; one far behind is never crossed again.
        tx = tx if tx > t else (t if tx > t - 1e-9 else math.inf)
        ty = ty if ty > t else (t if ty > t - 1e-9 else math.inf)
        out = min(tx, ty, end)
        entry = z + t * dz
        leave = z + out * dz if out < math.inf else (math.inf if dz > 0.0 else entry)
        i = screen.depth_level[level, 0] + cy * screen.depth_level[level, 1] + cx
        nearest = screen.depth[i]
        # In front of everything in the cell, or behind all of it: nothing here can be hit.
        clear_of = max(entry, leave) < nearest
        clear_of = clear_of or (level > 0 and min(entry, leave) > screen.farthest[i] * _BEHIND)
        if not clear_of:
            if level > 0:
                level -= 1
                continue
            # A pixel is no block of the depth in it but a window onto a plane. That plane may be met a little outside
            # of the pixel that shows it, where a neighbour shows the same surface; further off it is another one.
            s = _plane_distance(screen, ix, iy, nearest, origin, direction)
            slack = _SLACK * (out - t) if out < math.inf else math.inf
            if s > 0.0 and t - slack <= s <= out + slack:
                px, py, _ = project(view, along(origin, direction, s))
                if abs(px - ix - 0.5) <= 0.5 + _SLACK and abs(py - iy - 0.5) <= 0.5 + _SLACK:
                    return ScreenHit(True, px, py, s)
        if out >= end:
            break
        # On into the next cell, and a level up after a cell that was empty: long empty ways take few steps.
        t = out
        if tx <= ty:
            ix = edge_x if step_x > 0 else edge_x - 1
            iy = _other(ay + t * by, aw + t * bw, cy, level)
        else:
            iy = edge_y if step_y > 0 else edge_y - 1
            ix = _other(ax + t * bx, aw + t * bw, cx, level)
        if clear_of and level < last:
            level += 1
    return ScreenHit(False, 0.0, 0.0, 0.0)


@inlined
def _other(a: float, w: float, cell: int, level: int) -> int:
    """Pixel index of the coordinate that does not cross, kept inside the cell it is in."""
    low = cell << level
    return min(max(math.floor(a / w), low), low + (1 << level) - 1)


@inlined
def _on_surface(screen: Screen, origin: Vec, direction: Vec, hit: ScreenHit) -> Rgba:
    """Bilinear colour and coverage of the four nearest pixels, leaving out those that show another surface."""
    width, height = int(screen.camera.size[0]), int(screen.camera.size[1])
    x, y = hit.x - 0.5, hit.y - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    _, _, z = project(screen.camera, along(origin, direction, hit.distance))
    r = g = b = a = total = 0.0
    for k in range(4):
        ix, iy = x0 + k % 2, y0 + k // 2
        w = (x - x0 if k % 2 else 1.0 - x + x0) * (y - y0 if k // 2 else 1.0 - y + y0)
        ix, iy = min(max(ix, 0), width - 1), min(max(iy, 0), height - 1)
        depth = screen.depth[iy * width + ix]
        if depth == math.inf:
            continue
        # Pixels of one surface agree on where the ray meets it; those that do not, or are sky, show something else.
        met = _plane_distance(screen, ix, iy, depth, origin, direction)
        if met < 0.0 or abs(met - hit.distance) > _SAME * (hit.distance + z):
            continue
        i = iy * width + ix
        r += w * screen.color[i, 0]
        g += w * screen.color[i, 1]
        b += w * screen.color[i, 2]
        a += w * screen.color[i, 3]
        total += w
    if total > 1e-3:
        return (r / total, g / total, b / total, a / total)
    return color_at(screen, hit.x, hit.y, 0.0)


@inlined
def screen_march(screen: Screen, ray: Cone) -> ScreenLight:
    """What the march finds; the level of the pyramid is such that half of its blur falls within the cone at the hit."""
    hit = march(screen, ray.origin, ray.direction)
    if not hit.found:
        return ScreenLight(_NOTHING, 0.0, 0.0)
    w = edge_fade(hit.x / screen.camera.size[0], hit.y / screen.camera.size[1], SCREEN_FADE)
    if w <= 0.0:
        return ScreenLight(_NOTHING, 0.0, 0.0)
    lod = 0.0
    if ray.blur > 0.0:
        _, _, z = project(screen.camera, along(ray.origin, ray.direction, hit.distance))
        lod = _level(screen, ray.blur, hit.distance, z)
    if lod > 0.0:
        return ScreenLight(color_at(screen, hit.x, hit.y, lod), w, 1.0)
    return ScreenLight(_on_surface(screen, ray.origin, ray.direction, hit), w, 1.0)


@inlined
def light_seen(screen: Screen, point: Vec, facing: Vec, agreeing: bool) -> SeenLight:
    """The light that the picture shows to fall on the very place where a ray is known to end.

    A pixel shows that surface if it sees one that faces the same way, and in whose plane the point lies. Half of the
    bilinear weight around the point must be of such pixels. What they have in common is the light that falls there, not
    the colour: a texture is looked up by whoever asks, as finely as it likes.

    Args:
        point: where the ray meets the surface [m].
        facing: unit geometric normal there, on the ray's side.
        agreeing: only where the pixels agree about it, and with the shares that arrive. If it is noisy that must not
            be asked: it would favour the brightest and the darkest.
    """
    width, height = int(screen.camera.size[0]), int(screen.camera.size[1])
    px, py, z = project(screen.camera, point)
    x, y = px - 0.5, py - 0.5
    if z <= 0.0 or not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
        return _DARK
    x0, y0 = math.floor(x), math.floor(y)
    total, low, high = 0.0, math.inf, 0.0
    lamps = 0.0
    irradiance, gloss, sky = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(4):
        ix, iy = x0 + k % 2, y0 + k // 2
        depth = screen.depth[iy * width + ix]
        if depth == math.inf or dot(row(screen.normal[iy], ix), facing) < _ALIKE:
            continue
        seen = pixel_point(screen.camera, ix + 0.5, iy + 0.5, np.float64(depth))
        if abs(dot(sub(seen, point), facing)) > _COPLANAR * z:
            continue
        w = (x - x0 if k % 2 else 1.0 - x + x0) * (y - y0 if k // 2 else 1.0 - y + y0)
        total += w
        light = row(screen.irradiance[iy], ix)
        irradiance = along(irradiance, light, w)
        low, high = min(low, light[0] + light[1] + light[2]), max(high, light[0] + light[1] + light[2])
        gloss = along(gloss, row(screen.gloss[iy], ix), w)
        if agreeing:
            lamps += w * screen.seen[iy, ix, 0]
            sky = along(sky, row(screen.seen[iy, :, 1:], ix), w)
    if total < 0.5 or (agreeing and high - low > _AGREE * high):
        return _DARK
    irradiance, gloss = scale(irradiance, 1.0 / total), scale(gloss, 1.0 / total)
    return SeenLight(True, px, py, z, irradiance, gloss, lamps / total, scale(sky, 1.0 / total))


@inlined
def screen_blurred(screen: Screen, seen: SeenLight, blur: float, distance: float) -> Rgba:
    """Colour and coverage over the cone of a rough ray, around where it ends.

    Args:
        blur: tangent of the cone's half angle.
        distance: along the ray [m].
    """
    return color_at(screen, seen.x, seen.y, _level(screen, blur, distance, seen.z_depth))


@inlined
def _level(screen: Screen, blur: float, distance: float, z: float) -> float:
    """Level of the pyramid half of whose blur falls within a cone where it has gone so far."""
    radius = blur * distance / pixel_width(screen.camera, max(z, 1e-6)) / _LEVEL_MEDIAN
    return 0.5 * math.log2(1.0 + radius * radius)


@inlined
def screen_proxy(screen: Screen, ray: Cone, distance: float, shaded: PixelPoint, lod: float) -> ScreenLight:
    """HDRP's reprojection (Lit.hlsl, ScreenSpaceTracing.hlsl); its confidence is how well the proxy guessed the depth.

    Args:
        distance: to the proxy volume along the ray [m].
        shaded: the surface the ray comes from, as the camera sees it.
        lod: level of the colour pyramid.
    """
    width, height = int(screen.camera.size[0]), int(screen.camera.size[1])
    px, py, z = project(screen.camera, along(ray.origin, ray.direction, distance))
    if z <= 0.0:
        return ScreenLight(_NOTHING, 0.0, 0.0)
    w = edge_fade(px / width, py / height, SCREEN_FADE)
    if w <= 0.0:
        return ScreenLight(_NOTHING, 0.0, 0.0)
    # What is in front of the shaded surface cannot be behind it in the glass: then the lookup stays at its own pixel.
    # The rougher the lobe, the less it moves, since a coarse texel already holds both places.
    there = screen.depth[min(int(py), height - 1) * width + min(int(px), width - 1)]
    keep = max(0.0, 1.0 - 0.08 * lod) if there > shaded.z_depth else 0.0
    color = color_at(screen, shaded.x + (px - shaded.x) * keep, shaded.y + (py - shaded.y) * keep, lod)
    confidence = min(z, there) / max(z, there) if there < math.inf else 0.0
    return ScreenLight(color, w, confidence * keep)
