"""The screen tier: what a ray would see, read from the opaque picture the camera already has.

`march` follows the ray through the depth pyramid and accepts a pixel only where the ray meets the plane of the surface
seen there. `proxy` is HDRP's way: one guess at a proxy volume, reprojected, with no test but "not in front".
"""

from __future__ import annotations

import math

from ..kernels.compile import inlined
from ..kernels.vec import along, dot, row, sub
from ..probes.volumes import edge_fade
from .camera import pixel_point, pixel_width, project
from .pyramid import color_at

SCREEN_FADE = 0.1
"""Screen Weight Distance (HDRP's default)."""
_MAX_STEPS = 384
_FACING = 1e-3  # cosine below which a surface is seen too edge-on to be hit
_BEHIND = 1.001  # ratio of depths beyond which a ray counts as behind a surface
_LEVEL_MEDIAN = 1.92
"""Median radius of the colour pyramid's blur, in pixels of a level. Its variance is 8/3 (4^level - 1) pixels^2, from a
binomial filter of 2 texels^2 on each level, and half of a round Gaussian lies within 1.177 deviations."""
_SLACK = 1.0  # how far outside its pixel a plane may be met, in pixels' worth of the ray


@inlined
def _cross_distance(boundary, a, b, aw, bw):  # type: ignore[no-untyped-def]
    """Ray distance at which pixel coordinate (a + t b) / (aw + t bw) reaches `boundary`; inf if it never does."""
    denominator = b - boundary * bw
    if denominator == 0.0:
        return math.inf
    return (boundary * aw - a) / denominator


@inlined
def _plane_distance(screen, ix, iy, depth, origin, direction):  # type: ignore[no-untyped-def]
    """Ray distance to the plane of the surface seen in a pixel; -1 where the ray comes from behind or edge-on."""
    normal = row(screen.normal[iy], ix)
    facing = dot(direction, normal)
    if facing > -_FACING:
        return -1.0
    seen = pixel_point(screen.camera, ix + 0.5, iy + 0.5, depth)
    return dot(sub(seen, origin), normal) / facing


@inlined
def march(screen, origin, direction):  # type: ignore[no-untyped-def]
    """First opaque surface of the picture that the ray meets.

    The ray is cut by the cells of the depth pyramid (Uludag, "Hi-Z Screen-Space Cone-Traced Reflections", GPU Pro 5,
    2014), in exact distances along the ray. A cell is skipped while the ray is nearer than everything in it.

    Returns:
        (found, px, py, hit distance [m]); pixel coordinates are continuous.
    """
    view = screen.camera
    width, height = int(view.size[0]), int(view.size[1])
    # Homogeneous pixel coordinates, linear along the ray: (ax + t bx, ay + t by) / (aw + t bw).
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
        return False, 0.0, 0.0, 0.0
    end = (near - z) / dz if dz < 0.0 else math.inf
    step_x = 1 if bx * aw - ax * bw > 0.0 else -1
    step_y = 1 if by * aw - ay * bw > 0.0 else -1
    ix, iy = math.floor(ax / aw), math.floor(ay / aw)
    t = 0.0
    level = 2
    last = min(screen.depth_level.shape[0] - 1, 7)
    level = min(level, last)
    for _ in range(_MAX_STEPS):
        if ix < 0 or iy < 0 or ix >= width or iy >= height or t >= end:
            break
        cx, cy = ix >> level, iy >> level
        edge_x = (cx + 1 if step_x > 0 else cx) << level
        edge_y = (cy + 1 if step_y > 0 else cy) << level
        tx = _cross_distance(edge_x, ax, bx, aw, bw)
        ty = _cross_distance(edge_y, ay, by, aw, bw)
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
            s = _plane_distance(screen, ix, iy, nearest, origin, direction)
            slack = _SLACK * (out - t) if out < math.inf else math.inf
            if s > 0.0 and t - slack <= s <= out + slack:
                px, py, _ = project(view, along(origin, direction, s))
                if abs(px - ix - 0.5) <= 0.5 + _SLACK and abs(py - iy - 0.5) <= 0.5 + _SLACK:
                    return True, px, py, s
        if out >= end:
            break
        t = out
        if tx <= ty:
            ix = edge_x if step_x > 0 else edge_x - 1
            iy = _other(ay + t * by, aw + t * bw, cy, level)
        else:
            iy = edge_y if step_y > 0 else edge_y - 1
            ix = _other(ax + t * bx, aw + t * bw, cx, level)
        if clear_of and level < last:
            level += 1
    return False, 0.0, 0.0, 0.0


@inlined
def _other(a, w, cell, level):  # type: ignore[no-untyped-def]
    """Pixel index of the coordinate that does not cross, kept inside the cell it is in."""
    low = cell << level
    return min(max(math.floor(a / w), low), low + (1 << level) - 1)


@inlined
def _on_surface(screen, px, py, origin, direction, s):  # type: ignore[no-untyped-def]
    """Bilinear colour of the four nearest pixels, leaving out those that show another surface."""
    width, height = int(screen.camera.size[0]), int(screen.camera.size[1])
    x, y = px - 0.5, py - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    _, _, z = project(screen.camera, along(origin, direction, s))
    r = g = b = total = 0.0
    for k in range(4):
        ix, iy = x0 + k % 2, y0 + k // 2
        w = (x - x0 if k % 2 else 1.0 - x + x0) * (y - y0 if k // 2 else 1.0 - y + y0)
        ix, iy = min(max(ix, 0), width - 1), min(max(iy, 0), height - 1)
        depth = screen.depth[iy * width + ix]
        if depth == math.inf:
            continue
        met = _plane_distance(screen, ix, iy, depth, origin, direction)
        if met < 0.0 or abs(met - s) > 0.02 * (s + z):
            continue
        i = iy * width + ix
        r += w * screen.color[i, 0]
        g += w * screen.color[i, 1]
        b += w * screen.color[i, 2]
        total += w
    if total > 1e-3:
        return (r / total, g / total, b / total)
    return color_at(screen, px, py, 0.0)


@inlined
def screen_march(screen, origin, direction, blur):  # type: ignore[no-untyped-def]
    """Colour and weight of the march.

    Args:
        blur: tangent of the half angle of the rough cone; the pyramid level is chosen so that half of its blur falls
            within the cone at the hit.

    Returns:
        (colour, weight 0 .. 1, confidence 0 .. 1)
    """
    found, px, py, s = march(screen, origin, direction)
    if not found:
        return (0.0, 0.0, 0.0), 0.0, 0.0
    w = edge_fade(px / screen.camera.size[0], py / screen.camera.size[1], SCREEN_FADE)
    if w <= 0.0:
        return (0.0, 0.0, 0.0), 0.0, 0.0
    lod = 0.0
    if blur > 0.0:
        _, _, z = project(screen.camera, along(origin, direction, s))
        radius = blur * s / pixel_width(screen.camera, max(z, 1e-6)) / _LEVEL_MEDIAN
        lod = 0.5 * math.log2(1.0 + radius * radius)
    if lod > 0.0:
        return color_at(screen, px, py, lod), w, 1.0
    return _on_surface(screen, px, py, origin, direction, s), w, 1.0


@inlined
def screen_proxy(screen, origin, direction, distance, px_self, py_self, z_self, lod):  # type: ignore[no-untyped-def]
    """Colour and weight of HDRP's reprojection (Lit.hlsl, ScreenSpaceTracing.hlsl).

    Args:
        distance: to the proxy volume along the ray [m].
        px_self, py_self, z_self: the shaded pixel and its own z_depth.
        lod: level of the colour pyramid.

    Returns:
        (colour, weight 0 .. 1, confidence 0 .. 1: how well the proxy guessed the depth that is there)
    """
    width, height = int(screen.camera.size[0]), int(screen.camera.size[1])
    px, py, z = project(screen.camera, along(origin, direction, distance))
    if z <= 0.0:
        return (0.0, 0.0, 0.0), 0.0, 0.0
    w = edge_fade(px / width, py / height, SCREEN_FADE)
    if w <= 0.0:
        return (0.0, 0.0, 0.0), 0.0, 0.0
    there = screen.depth[min(int(py), height - 1) * width + min(int(px), width - 1)]
    keep = max(0.0, 1.0 - 0.08 * lod) if there > z_self else 0.0
    color = color_at(screen, px_self + (px - px_self) * keep, py_self + (py - py_self) * keep, lod)
    confidence = min(z, there) / max(z, there) if there < math.inf else 0.0
    return color, w, confidence * keep
