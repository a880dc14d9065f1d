"""The dome around the scene as kernels see it: filtered radiance, irradiance, and directions drawn by brightness.

The map is latlong, as `scene.Environment` says. Its mips hold exact means over solid angle. The two poles are single
values in every level, and lookups run around in u, so that no seam exists anywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..errors import SceneError
from ..kernels.arrays import F32_2D, F32_3D, F64_1D, F64_2D, I16_1D, I16_2D, I64_2D
from ..kernels.compile import inlined, kernel
from ..kernels.vec import Vec, row, transform_direction
from ..scene import F32, F64, Environment

MAX_RADIANCE = 1e30
"""Brighter pixels, and infinite ones, are cut to this, so that sums stay finite in float32."""
IRRADIANCE_SHAPE = (32, 64)
SOURCE_SHAPE = (64, 128)
"""Texels the irradiance is summed over."""
SAMPLING_SHAPE = (256, 512)
"""Most texels that directions are drawn from."""
FLOOR_SHARE = 0.01
"""Share of the drawn directions that are spread evenly, so that nothing the bilinear lookup shows is never drawn."""
LOBE_FOOTPRINT = (4.0, 1.6)
"""Footprint of a GGX lobe [rad] is the first times alpha over 1 + the second times alpha; see `prefiltered`."""
TEXEL_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. ITU-R BT.709

I16 = np.ndarray[tuple[int, ...], np.dtype[np.int16]]
I64 = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

_EVEN = 1e-3


class EnvironmentTable(NamedTuple):
    """Arrays of one environment. Without one, the same shape of things in black."""

    present: bool
    dark: bool
    """it is black all over: it covers what is behind it, and lights nothing"""
    even: bool
    """it is the same from everywhere, to a thousandth"""
    pool: F32_2D
    """shape (N, 3): radiance of every level, row by row, level after level"""
    levels: I64_2D
    """shape (L, 3): offset into `pool`, height, width; level 0 is the map"""
    poles: F32_3D
    """shape (L, 2, 3): radiance at +Y and -Y of the dome"""
    dome_from_world: F64_2D
    """shape (3, 3)"""
    irradiance_pool: F32_2D
    """shape (32 * 64, 3): irradiance [radiance * sr] of a surface that faces the texel's direction"""
    irradiance_poles: F32_2D
    """shape (2, 3)"""
    row_cdf: F64_1D
    """shape (H + 1,): chance that a drawn direction lies above row i"""
    column_cdf: F32_2D
    """shape (H, W + 1): within a row, chance that it lies before column i; small, as it is read at random"""
    row_guide: I16_1D
    """shape (G,): the row that chance i / G falls into, where the search for a row begins"""
    column_guide: I16_2D
    """shape (H, G): the same for columns within a row"""
    row_cosines: F64_1D
    """shape (H + 1,): cosine of the angle to +Y above row i"""
    hidden: bool
    """what is seen past everything, and through glass, is the backdrop"""
    open: bool
    """and that is nothing at all"""
    backdrop: F64_1D
    """shape (3,): radiance"""
    tint: F32_2D
    """shape (H * W, 3): colour of what comes from a texel that directions are drawn from, at luminance 1"""


def pack(environment: Environment | None) -> EnvironmentTable:
    """Filter an environment into the table kernels read.

    Args:
        environment: None stands for black. Pixels that are negative or NaN count as 0.

    Raises:
        SceneError: The map is not (H, W, 3) or the rotation not (3, 3) and finite.
    """
    pixels, rotation = np.zeros((1, 2, 3), np.float32), np.eye(3)
    hidden, backdrop = False, None
    if environment is not None:
        pixels, rotation = _checked(environment)
        hidden, backdrop = environment.hidden, environment.backdrop
    pool, levels, poles = _pyramid(pixels)
    irradiance_pool = np.zeros((IRRADIANCE_SHAPE[0] * IRRADIANCE_SHAPE[1], 3), np.float32)
    if environment is not None:
        source = np.empty((*SOURCE_SHAPE, 3), np.float32)
        _resample(_level_over(pool, levels, SOURCE_SHAPE), source)
        _convolve(source, _directions(*SOURCE_SHAPE), _directions(*IRRADIANCE_SHAPE), irradiance_pool)
    row_cdf, column_cdf, tint = _distribution(_level_over(pool, levels, SAMPLING_SHAPE))
    return EnvironmentTable(
        present=environment is not None,
        dark=not pool[-1].any(),  # the last level is the mean of what is never negative
        even=bool((pixels.max((0, 1)) - pixels.min((0, 1)) <= _EVEN * pixels.max((0, 1))).all()),
        pool=pool,
        levels=levels,
        poles=poles,
        dome_from_world=rotation,
        irradiance_pool=irradiance_pool,
        irradiance_poles=_pole_means(irradiance_pool.reshape(*IRRADIANCE_SHAPE, 3)),
        row_cdf=row_cdf,
        column_cdf=column_cdf,
        row_guide=guide_of(row_cdf),
        column_guide=np.stack([guide_of(cdf) for cdf in column_cdf]),
        row_cosines=np.cos(np.linspace(0.0, math.pi, len(row_cdf))),
        hidden=hidden,
        open=hidden and backdrop is None,
        backdrop=np.array(backdrop or (0.0, 0.0, 0.0), np.float64),
        tint=tint,
    )


def _checked(environment: Environment) -> tuple[F32, F64]:
    """Pixels as contiguous float32 and the rotation as an array of our own."""
    pixels = np.ascontiguousarray(environment.pixels, np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise SceneError(f"environment.pixels has shape {pixels.shape}; it must be (height, width, 3), at least 1 x 1")
    rotation = np.array(environment.dome_from_world, np.float64, order="C")
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise SceneError(f"environment.dome_from_world is {rotation}; it must be a finite 3 x 3 rotation")
    return pixels, rotation


def _pyramid(pixels: F32) -> tuple[F32, I64, F32]:
    """All levels down to 1 x 1, each half the one before, in one pool; their places; their poles."""
    height, width, _ = pixels.shape
    places = [(0, height, width)]
    while max(height, width) > 1:
        offset = places[-1][0] + height * width
        height, width = max(height // 2, 1), max(width // 2, 1)
        places.append((offset, height, width))
    pool = np.empty((places[-1][0] + 1, 3), np.float32)
    levels = np.array(places, np.int64)
    poles = np.empty((len(places), 2, 3), np.float32)
    _copy_clean(pixels.reshape(-1, 3), pool)
    for k in range(len(places)):
        if k > 0:
            _resample(_level(pool, levels, k - 1), _level(pool, levels, k))
        poles[k] = _pole_means(_level(pool, levels, k))
    return pool, levels, poles


def _level(pool: F32, levels: I64, k: int) -> F32:
    """View of one level, shape (height, width, 3)."""
    offset, height, width = (int(x) for x in levels[k])
    return pool[offset : offset + height * width].reshape(height, width, 3)


def _level_over(pool: F32, levels: I64, shape: tuple[int, int]) -> F32:
    """The coarsest level that still has at least `shape` texels each way; level 0 where none has."""
    enough = np.flatnonzero((levels[:, 1] >= shape[0]) & (levels[:, 2] >= shape[1]))
    return _level(pool, levels, int(enough[-1]) if len(enough) else 0)


def _pole_means(pixels: F32) -> F32:
    """Means of the first and the last row, shape (2, 3)."""
    return np.asarray(pixels[[0, -1]].mean(axis=1, dtype=np.float64), np.float32)


def _solid_angles(height: int, width: int) -> F64:
    """Solid angle of one texel of each row [sr], shape (height,)."""
    cosines = np.cos(np.linspace(0.0, math.pi, height + 1))
    return np.asarray((cosines[:-1] - cosines[1:]) * (2.0 * math.pi / width))


def _directions(height: int, width: int) -> F64:
    """Unit vectors at the texels' centres in the dome's frame, shape (height * width, 3)."""
    theta = (np.arange(height) + 0.5)[:, None] * (math.pi / height)
    phi = (0.5 - (np.arange(width) + 0.5)[None, :] / width) * (2.0 * math.pi)
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi, np.sin(theta) * np.cos(phi)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _distribution(pixels: F32) -> tuple[F64, F32, F32]:
    """Cumulative chances of rows, and of columns within rows, for directions drawn by luminance; and texels' tints."""
    shape = (min(pixels.shape[0], SAMPLING_SHAPE[0]), min(pixels.shape[1], SAMPLING_SHAPE[1]))
    small = np.empty((*shape, 3), np.float32)
    _resample(pixels, small)
    light = small.astype(np.float64)
    # A bilinear lookup carries an eighth of a texel's light, along each axis, into either neighbour.
    light = 0.75 * light + 0.125 * (np.roll(light, 1, axis=1) + np.roll(light, -1, axis=1))
    padded = np.pad(light, ((1, 1), (0, 0), (0, 0)), mode="edge")
    light = 0.75 * light + 0.125 * (padded[:-2] + padded[2:])
    bright = light @ np.array(TEXEL_LUMINANCE)
    tint = np.divide(light, bright[..., None], out=np.ones_like(light), where=bright[..., None] > 0.0)
    areas = _solid_angles(*shape)[:, None]
    mean = float((bright * areas).sum()) / (4.0 * math.pi)
    chances = (bright * ((1.0 - FLOOR_SHARE) / mean) + FLOOR_SHARE if mean > 0.0 else np.ones(shape)) * areas
    column_cdf = np.zeros((shape[0], shape[1] + 1))
    np.cumsum(chances, axis=1, out=column_cdf[:, 1:])
    rows = column_cdf[:, -1].copy()
    row_cdf = np.concatenate([[0.0], np.cumsum(rows)])
    column_cdf /= rows[:, None]
    row_cdf /= row_cdf[-1]
    column_cdf[:, -1] = 1.0
    return row_cdf, column_cdf.astype(np.float32), tint.reshape(-1, 3).astype(np.float32)


def guide_of(cdf: F32 | F64) -> I16:
    """Where the search for a chance begins: shape (G,), an entry for four intervals (Chen and Asau 1974).

    A search by halves in a table that is large and read at random waits for memory at every step; a guide leaves two.

    Args:
        cdf: shape (N + 1,), N up to 32767: chance before interval i; the last is 1.
    """
    count = max((len(cdf) - 1) // 4, 1)
    return (np.searchsorted(cdf, np.arange(count) / count, side="right") - 1).astype(np.int16)


@kernel
def _copy_clean(source: F32_2D, target: F32_2D) -> None:
    """Copy rows of pixels; negative and NaN become 0, too bright ones are cut."""
    limit = np.float32(MAX_RADIANCE)
    for i in range(source.shape[0]):
        for c in range(3):
            value = source[i, c]
            target[i, c] = min(value, limit) if value > 0.0 else np.float32(0.0)


@kernel
def _resample(source: F32_3D, target: F32_3D) -> None:
    """Mean over the solid angle of each target texel, for any two sizes."""
    height, width = source.shape[0], source.shape[1]
    rows, columns = target.shape[0], target.shape[1]
    for j in range(rows):
        top, bottom = j * height / rows, (j + 1) * height / rows
        whole = math.cos(top * math.pi / height) - math.cos(bottom * math.pi / height)
        target[j] = 0.0
        for y in range(int(top), min(math.ceil(bottom), height)):
            upper, lower = max(top, float(y)), min(bottom, y + 1.0)
            share = math.cos(upper * math.pi / height) - math.cos(lower * math.pi / height)
            _add_row(source[y], share / whole, width / columns, target[j])


@inlined
def _add_row(source: F32, weight: float, step: float, target: F32) -> None:
    """Add the means of one row of pixels, `step` of them to each target texel."""
    for column in range(target.shape[0]):
        left, right = column * step, min((column + 1) * step, float(source.shape[0]))
        r, g, b = 0.0, 0.0, 0.0
        for x in range(int(left), min(math.ceil(right), source.shape[0])):
            share = min(right, x + 1.0) - max(left, float(x))
            r += share * source[x, 0]
            g += share * source[x, 1]
            b += share * source[x, 2]
        scale = weight / (right - left)
        target[column, 0] += np.float32(r * scale)
        target[column, 1] += np.float32(g * scale)
        target[column, 2] += np.float32(b * scale)


@kernel
def _convolve(source: F32_3D, lights: F64_2D, normals: F64_2D, out: F32_2D) -> None:
    """Irradiance for each normal: radiance times cosine over solid angle, its weights made to sum to pi."""
    height, width = source.shape[0], source.shape[1]
    for i in range(normals.shape[0]):
        r, g, b, total = 0.0, 0.0, 0.0, 0.0
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for y in range(height):
            area = math.cos(y * math.pi / height) - math.cos((y + 1) * math.pi / height)
            for x in range(width):
                k = y * width + x
                weight = max(nx * lights[k, 0] + ny * lights[k, 1] + nz * lights[k, 2], 0.0) * area
                r += weight * source[y, x, 0]
                g += weight * source[y, x, 1]
                b += weight * source[y, x, 2]
                total += weight
        out[i, 0], out[i, 1], out[i, 2] = r * math.pi / total, g * math.pi / total, b * math.pi / total


@inlined
def _position(table: EnvironmentTable, d: Vec) -> tuple[float, float]:
    """u in 0 .. 1 and v in 0 .. 1 of a world direction of any length."""
    x, y, z = transform_direction(table.dome_from_world, d)
    return 0.5 - math.atan2(x, z) / (2.0 * math.pi), math.atan2(math.sqrt(x * x + z * z), y) / math.pi


@inlined
def _along_row(pool: F32, start: int, width: int, x: float) -> Vec:
    """Linear lookup in one row, running around; `x` is 0 at the centre of the first texel."""
    left = math.floor(x)
    t = x - left
    a = start + int(left) % width
    b = start + (int(left) + 1) % width
    return (
        (1.0 - t) * pool[a, 0] + t * pool[b, 0],
        (1.0 - t) * pool[a, 1] + t * pool[b, 1],
        (1.0 - t) * pool[a, 2] + t * pool[b, 2],
    )


@inlined
def _bilinear(pool: F32, offset: int, height: int, width: int, poles: F32, u: float, v: float) -> Vec:
    """Lookup in one level; between the outermost rows and their pole it blends towards the pole's single value."""
    x, y = u * width - 0.5, v * height - 0.5
    if y < 0.0 or y > height - 1.0:
        pole = 0 if y < 0.0 else 1
        t = min(2.0 * (-y if y < 0.0 else y - (height - 1.0)), 1.0)
        edge = _along_row(pool, offset + (0 if y < 0.0 else height - 1) * width, width, x)
        return (
            (1.0 - t) * edge[0] + t * poles[pole, 0],
            (1.0 - t) * edge[1] + t * poles[pole, 1],
            (1.0 - t) * edge[2] + t * poles[pole, 2],
        )
    row = min(int(y), max(height - 2, 0))
    t = y - row
    above = _along_row(pool, offset + row * width, width, x)
    below = _along_row(pool, offset + min(row + 1, height - 1) * width, width, x)
    return (
        (1.0 - t) * above[0] + t * below[0],
        (1.0 - t) * above[1] + t * below[1],
        (1.0 - t) * above[2] + t * below[2],
    )


@inlined
def _at_level(table: EnvironmentTable, level: int, u: float, v: float) -> Vec:
    offset, height, width = table.levels[level, 0], table.levels[level, 1], table.levels[level, 2]
    return _bilinear(table.pool, offset, height, width, table.poles[level], u, v)


@inlined
def radiance(table: EnvironmentTable, d: Vec, footprint: float) -> Vec:
    """Radiance from world direction `d` of any length, averaged over about `footprint`.

    Args:
        table: From `pack`.
        d: World direction the ray travels in.
        footprint: Full width of the cone or pixel [rad]; 0 is the map itself.
    """
    if not table.present:
        return (0.0, 0.0, 0.0)
    u, v = _position(table, d)
    texel = math.pi * max(1.0 / table.levels[0, 1], 2.0 / table.levels[0, 2])
    if footprint <= texel:
        return _at_level(table, 0, u, v)
    lod = min(math.log2(footprint / texel), table.levels.shape[0] - 1.0)
    level = int(lod)
    t = lod - level
    a = _at_level(table, level, u, v)
    if t <= 0.0:
        return a
    b = _at_level(table, level + 1, u, v)
    return ((1.0 - t) * a[0] + t * b[0], (1.0 - t) * a[1] + t * b[1], (1.0 - t) * a[2] + t * b[2])


@inlined
def background(table: EnvironmentTable, d: Vec) -> tuple[Vec, float]:
    """What a view ray sees that meets nothing, and how much that covers, 0 or 1.

    Args:
        table: From `pack`.
        d: World direction the ray travels in.
    """
    if not table.present or table.open:
        return (0.0, 0.0, 0.0), 0.0
    if table.hidden:
        return (table.backdrop[0], table.backdrop[1], table.backdrop[2]), 1.0
    return radiance(table, d, 0.0), 1.0


@inlined
def prefiltered(table: EnvironmentTable, d: Vec, roughness: float) -> Vec:
    """Radiance over about the GGX reflection lobe around world direction `d`, by footprint.

    The lobe is D(h) cos(l) seen along the normal, as probes are filtered (Karis 2013), alpha = roughness squared. Its
    footprint 4 alpha / (1 + 1.6 alpha) was fitted to that integral on an edge and on noise of three sizes; the horizon
    cuts wide lobes, hence the denominator.

    Args:
        table: From `pack`.
        d: World direction of the lobe.
        roughness: Perceptual, 0 .. 1.
    """
    alpha = roughness * roughness
    return radiance(table, d, LOBE_FOOTPRINT[0] * alpha / (1.0 + LOBE_FOOTPRINT[1] * alpha))


@inlined
def irradiance(table: EnvironmentTable, n: Vec) -> Vec:
    """Irradiance [radiance * sr] of a surface with world normal `n`; divide by pi for a white diffuse surface."""
    if not table.present:
        return (0.0, 0.0, 0.0)
    u, v = _position(table, n)
    height, width = IRRADIANCE_SHAPE
    return _bilinear(table.irradiance_pool, 0, height, width, table.irradiance_poles, u, v)


@inlined
def pick(cdf: F32 | F64, guide: I16, u: float) -> int:
    """Index i with cdf[i] <= u < cdf[i + 1], of an interval that is not empty, for u in 0 .. 1."""
    cells, last = guide.shape[0], cdf.shape[0] - 2
    i = int(guide[min(int(u * cells), cells - 1)])
    while i < last and cdf[i + 1] <= u:
        i += 1
    return i


@inlined
def _texel_pdf(table: EnvironmentTable, row: int, column: int) -> float:
    """Chance per solid angle within a texel of the sampling map [1/sr]."""
    columns = table.column_cdf.shape[1] - 1
    chance = (table.row_cdf[row + 1] - table.row_cdf[row]) * (
        table.column_cdf[row, column + 1] - table.column_cdf[row, column]
    )
    band = table.row_cosines[row] - table.row_cosines[row + 1]
    return chance / (band * (2.0 * math.pi / columns))


@inlined
def _tint(table: EnvironmentTable, y: int, x: int) -> Vec:
    return row(table.tint, y * (table.column_cdf.shape[1] - 1) + x)


@inlined
def sample_direction(table: EnvironmentTable, u1: float, u2: float) -> tuple[Vec, float, Vec]:
    """Draw a direction in proportion to luminance, one in a hundred evenly (inversion; PBRT 4, section 12.5).

    Args:
        table: From `pack`.
        u1: Uniform in 0 .. 1, picks the row and the place in it.
        u2: Uniform in 0 .. 1, picks the column and the place in it.

    Returns:
        Unit world direction towards the light, its density [1/sr], > 0, and the tint of what comes from there.
    """
    columns = table.column_cdf.shape[1] - 1
    row = pick(table.row_cdf, table.row_guide, u1)
    column = pick(table.column_cdf[row], table.column_guide[row], u2)
    down = (u1 - table.row_cdf[row]) / (table.row_cdf[row + 1] - table.row_cdf[row])
    low, high = table.column_cdf[row, column], table.column_cdf[row, column + 1]
    across = (u2 - low) / (high - low)
    top, bottom = table.row_cosines[row], table.row_cosines[row + 1]
    y = top + (bottom - top) * min(max(down, 0.0), 1.0)
    phi = (0.5 - (column + min(max(across, 0.0), 1.0)) / columns) * (2.0 * math.pi)
    radius = math.sqrt(max(1.0 - y * y, 0.0))
    x, z = radius * math.sin(phi), radius * math.cos(phi)
    m = table.dome_from_world
    world = (
        m[0, 0] * x + m[1, 0] * y + m[2, 0] * z,
        m[0, 1] * x + m[1, 1] * y + m[2, 1] * z,
        m[0, 2] * x + m[1, 2] * y + m[2, 2] * z,
    )
    return world, _texel_pdf(table, row, column), _tint(table, row, column)


@inlined
def direction_pdf(table: EnvironmentTable, d: Vec) -> tuple[float, Vec]:
    """Density with which `sample_direction` draws world direction `d` [1/sr], and the tint of what comes from there."""
    u, v = _position(table, d)
    rows, columns = table.column_cdf.shape[0], table.column_cdf.shape[1] - 1
    row, column = min(int(v * rows), rows - 1), min(max(int(u * columns), 0), columns - 1)
    return _texel_pdf(table, row, column), _tint(table, row, column)
