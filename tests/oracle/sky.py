"""The environment: radiance by direction and footprint, irradiance, and directions drawn by brightness."""

from __future__ import annotations

import bisect
import math
from functools import cached_property

from refract_core.scene import Environment

from .vec import Vec, add, clamp, dot, mix, scaled, vec

Image = list[list[Vec]]
"""Latlong rows from +Y down."""

_IRRADIANCE = (32, 64)
_SOURCE = (64, 128)
_EVENLY = 0.01
"""Share of the drawn directions that follow no brightness."""
_MOST = 1e30


_KNOWN: dict[int, tuple[Environment, Sky]] = {}


def sky_of(environment: Environment) -> Sky:
    """One `Sky` for each environment: its irradiance takes long to sum, and scenes share it."""
    if id(environment) not in _KNOWN:
        _KNOWN[id(environment)] = environment, Sky(environment)
    return _KNOWN[id(environment)][1]


class Sky:
    """One environment. Lookups are bilinear on the map's mip chain and meet in one value at each pole."""

    def __init__(self, environment: Environment) -> None:
        self.turn = [vec(row) for row in environment.dome_from_world]
        clean = [[vec([_clean(float(x)) for x in texel]) for texel in row] for row in environment.pixels]
        self.levels: list[Image] = [clean]
        while len(clean) > 1 or len(clean[0]) > 1:
            clean = resampled(clean, max(len(clean) // 2, 1), max(len(clean[0]) // 2, 1))
            self.levels.append(clean)
        texels = [texel for row in self.levels[0] for texel in row]
        self.even = all(max(c) - min(c) <= 1e-3 * max(c) for c in zip(*texels, strict=True))
        """the same from everywhere"""
        self._known: dict[tuple[int, int], Vec] = {}

    # --- Lookups ---

    def radiance(self, d: Vec, footprint: float) -> Vec:
        """From world direction `d`, over a cone of `footprint` radians."""
        u, v = self._uv(d)
        height, width = len(self.levels[0]), len(self.levels[0][0])
        texel = max(math.pi / height, 2.0 * math.pi / width)
        lod = min(math.log2(footprint / texel), len(self.levels) - 1.0) if footprint > texel else 0.0
        fine = int(lod)
        found = _lookup(self.levels[fine], u, v)
        if lod > fine:
            found = mix(found, _lookup(self.levels[fine + 1], u, v), lod - fine)
        return found

    def lobe(self, d: Vec, roughness: float) -> Vec:
        """Over the GGX lobe of a perceptual roughness, taken as a footprint of 4 alpha / (1 + 1.6 alpha)."""
        alpha = roughness * roughness
        return self.radiance(d, 4.0 * alpha / (1.0 + 1.6 * alpha))

    def irradiance(self, n: Vec) -> Vec:
        """Of a surface that faces `n`: bilinear between the texels of a small latlong table."""
        u, v = self._uv(n)
        return _lookup_with(self._irradiance_texel, *_IRRADIANCE, u, v)

    def _uv(self, d: Vec) -> tuple[float, float]:
        x, y, z = (dot(row, d) for row in self.turn)
        return 0.5 - math.atan2(x, z) / (2.0 * math.pi), math.atan2(math.hypot(x, z), y) / math.pi

    # --- Irradiance: radiance times cosine, summed over the sphere in steps of 2.8 degrees ---

    @cached_property
    def _lamps(self) -> list[tuple[float, float, float, float, Vec]]:
        height, width = _SOURCE
        enough = [k for k, im in enumerate(self.levels) if len(im) >= height and len(im[0]) >= width]
        source = resampled(self.levels[enough[-1] if enough else 0], height, width)
        lamps = []
        for y in range(height):
            area = math.cos(y * math.pi / height) - math.cos((y + 1) * math.pi / height)
            for x in range(width):
                d = direction((x + 0.5) / width, (y + 0.5) / height)
                lamps.append((*d, area, source[y][x]))
        return lamps

    def _irradiance_texel(self, row: int, column: int) -> Vec:
        if (row, column) not in self._known:
            nx, ny, nz = direction((column + 0.5) / _IRRADIANCE[1], (row + 0.5) / _IRRADIANCE[0])
            r = g = b = total = 0.0
            for x, y, z, area, light in self._lamps:
                cosine = nx * x + ny * y + nz * z
                if cosine > 0.0:
                    weight = cosine * area
                    r += weight * light[0]
                    g += weight * light[1]
                    b += weight * light[2]
                    total += weight
            self._known[row, column] = scaled((r, g, b), math.pi / total)
        return self._known[row, column]

    # --- Drawing ---

    @cached_property
    def _chances(self) -> tuple[list[float], list[list[float]]]:
        """Cumulative chance of rows, and of columns in each row."""
        spread = [[0.2126 * t[0] + 0.7152 * t[1] + 0.0722 * t[2] for t in row] for row in self._blurred]
        height, width = len(spread), len(spread[0])
        areas = _areas(height, width)
        mean = sum(a * sum(row) for a, row in zip(areas, spread, strict=True)) / (4.0 * math.pi)
        chance = [
            [((1.0 - _EVENLY) * b / mean + _EVENLY if mean > 0.0 else 1.0) * a for b in row]
            for a, row in zip(areas, spread, strict=True)
        ]
        return _cumulative([sum(row) for row in chance]), [_cumulative(row) for row in chance]

    @cached_property
    def _blurred(self) -> Image:
        """The map as directions are drawn from it."""
        image = self.levels[0]
        height, width = len(image), len(image[0])
        if height > 256 or width > 512:
            raise NotImplementedError("directions on larger maps are drawn from a coarser level")
        # A bilinear lookup spreads an eighth of a texel's light into each neighbour.
        across = [
            [add(scaled(r[x], 0.75), scaled(add(r[x - 1], r[(x + 1) % width]), 0.125)) for x in range(width)]
            for r in image
        ]
        spread = []
        for y in range(height):
            up, down = across[max(y - 1, 0)], across[min(y + 1, height - 1)]
            spread.append(
                [add(scaled(across[y][x], 0.75), scaled(add(up[x], down[x]), 0.125)) for x in range(width)]
            )
        return spread

    def blurred(self, d: Vec) -> Vec:
        """Radiance of the texel that a world direction is drawn in; white where it is black."""
        u, v = self._uv(d)
        height, width = len(self._blurred), len(self._blurred[0])
        light = self._blurred[min(int(v * height), height - 1)][min(int(u * width), width - 1)]
        return light if max(light) > 0.0 else (1.0, 1.0, 1.0)

    def density(self, d: Vec) -> float:
        """Chance per solid angle with which `drawn` gives a world direction [1/sr]."""
        rows, columns = self._chances
        height, width = len(rows) - 1, len(columns[0]) - 1
        u, v = self._uv(d)
        row, column = min(int(v * height), height - 1), min(int(u * width), width - 1)
        chance = (rows[row + 1] - rows[row]) * (columns[row][column + 1] - columns[row][column])
        band = math.cos(row * math.pi / height) - math.cos((row + 1) * math.pi / height)
        return chance / (band * 2.0 * math.pi / width)

    def drawn(self, u1: float, u2: float) -> Vec:
        """A world direction, in proportion to luminance."""
        rows, columns = self._chances
        height = len(rows) - 1
        row = _interval(rows, u1)
        column = _interval(columns[row], u2)
        down = (u1 - rows[row]) / (rows[row + 1] - rows[row])
        across = (u2 - columns[row][column]) / (columns[row][column + 1] - columns[row][column])
        top, bottom = math.cos(row * math.pi / height), math.cos((row + 1) * math.pi / height)
        y = top + (bottom - top) * clamp(down)
        phi = (0.5 - (column + clamp(across)) / (len(columns[row]) - 1)) * 2.0 * math.pi
        radius = math.sqrt(max(1.0 - y * y, 0.0))
        local = (radius * math.sin(phi), y, radius * math.cos(phi))
        x_axis, y_axis, z_axis = self.turn
        return add(add(scaled(x_axis, local[0]), scaled(y_axis, local[1])), scaled(z_axis, local[2]))


def direction(u: float, v: float) -> Vec:
    """Of a place in the latlong map: its centre looks along +Z, u grows towards -X."""
    theta, phi = v * math.pi, (0.5 - u) * 2.0 * math.pi
    return (math.sin(theta) * math.sin(phi), math.cos(theta), math.sin(theta) * math.cos(phi))


def resampled(image: Image, rows: int, columns: int) -> Image:
    """Means over the solid angle of each new texel, for any two sizes."""
    height, width = len(image), len(image[0])
    out = []
    for j in range(rows):
        bands = _overlaps(j, rows, height)
        shares = [(y, math.cos(low * math.pi / height) - math.cos(high * math.pi / height)) for y, low, high in bands]
        whole = sum(share for _, share in shares)
        line = []
        for i in range(columns):
            cells = [(x, high - low) for x, low, high in _overlaps(i, columns, width)]
            across = sum(share for _, share in cells)
            total = (0.0, 0.0, 0.0)
            for y, share in shares:
                for x, part in cells:
                    total = add(total, scaled(image[y][x], share / whole * part / across))
            line.append(total)
        out.append(line)
    return out


def _overlaps(i: int, count: int, size: int) -> list[tuple[int, float, float]]:
    """Old texels under new texel `i`: index, and from where to where it is covered."""
    low, high = i * size / count, (i + 1) * size / count
    found = [(k, max(low, float(k)), min(high, k + 1.0)) for k in range(int(low), min(math.ceil(high), size))]
    return [part for part in found if part[2] - part[1] > 1e-12]


def _lookup(image: Image, u: float, v: float) -> Vec:
    return _lookup_with(lambda row, column: image[row][column], len(image), len(image[0]), u, v)


def _lookup_with(texel, height: int, width: int, u: float, v: float) -> Vec:  # type: ignore[no-untyped-def]
    """Bilinear around the circle; in the outer half of the outermost rows it runs into the mean of that row."""
    y = v * height - 0.5

    def along(row: int) -> Vec:
        x = u * width - 0.5
        left = math.floor(x)
        return mix(texel(row, left % width), texel(row, (left + 1) % width), x - left)

    if 0.0 <= y <= height - 1.0:
        row = min(int(y), max(height - 2, 0))
        return mix(along(row), along(min(row + 1, height - 1)), y - row)
    row, outside = (0, -y) if y < 0.0 else (height - 1, y - (height - 1.0))
    pole = (0.0, 0.0, 0.0)
    for column in range(width):
        pole = add(pole, scaled(texel(row, column), 1.0 / width))
    return mix(along(row), pole, min(2.0 * outside, 1.0))


def _areas(height: int, width: int) -> list[float]:
    edges = [math.cos(k * math.pi / height) for k in range(height + 1)]
    return [(edges[k] - edges[k + 1]) * 2.0 * math.pi / width for k in range(height)]


def _cumulative(shares: list[float]) -> list[float]:
    out, so_far, total = [0.0], 0.0, sum(shares)
    for share in shares:
        so_far += share
        out.append(so_far / total)
    out[-1] = 1.0
    return out


def _interval(cdf: list[float], u: float) -> int:
    return min(bisect.bisect_right(cdf, u) - 1, len(cdf) - 2)


def _clean(x: float) -> float:
    return min(x, _MOST) if x > 0.0 else 0.0
