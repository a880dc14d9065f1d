"""The border to Embree: known hits, masks, exact spheres, refusals, and handles that are given back."""

from __future__ import annotations

import gc
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.errors import SceneError
from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import LANES
from refract_core.kernels.pointer import Pointer
from refract_core.world import embree
from refract_core.world.embree import Bvh, Packet, Part

F32 = NDArray[np.float32]

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


@kernel
def nearest(packet, handle, coherent):  # type: ignore[no-untyped-def]
    embree.intersect(packet, handle, coherent)


@kernel
def anything(packet, handle, coherent):  # type: ignore[no-untyped-def]
    embree.occluded(packet, handle, coherent)


def packet_of(origins: Any, directions: Any, masks: Any = -1, far: float = math.inf) -> Packet:
    """A packet whose first lanes hold the given rays."""
    packet = Packet.fresh()
    count = len(origins)
    packet.rays[embree.ORG_X : embree.ORG_Z + 1, :count] = np.asarray(origins, np.float32).T
    packet.rays[embree.DIR_X : embree.DIR_Z + 1, :count] = np.asarray(directions, np.float32).T
    packet.rays[embree.T_FAR] = far
    packet.words[embree.MASK, :count] = masks
    packet.words[embree.PRIM :] = -1
    packet.valid[:count] = -1
    return packet


def shoot(bvh: Bvh, origins: Any, directions: Any, masks: Any = -1, coherent: bool = False) -> Packet:
    packet = packet_of(origins, directions, masks)
    nearest(Pointer(packet), bvh.handle, coherent)
    return packet


def square_at(z: float) -> F32:
    return SQUARE + np.array([0, 0, z], np.float32)


@pytest.mark.parametrize("coherent", [True, False])
def test_a_ray_meets_a_triangle_where_geometry_says(coherent: bool) -> None:
    """Plane z = 0 seen from (0.5, -0.25, 3) along (0, 0, -2): distance 3 / 2 of the direction, primitive 0 (y < x)."""
    hit = shoot(Bvh(SQUARE, [Part(1, QUAD)]), [(0.5, -0.25, 3)], [(0, 0, -2)], coherent=coherent)
    assert hit.rays[embree.T_FAR, 0] == pytest.approx(1.5, rel=1e-6)
    assert (hit.words[embree.GEOM, 0], hit.words[embree.PRIM, 0]) == (0, 0)
    # Barycentric: p = a + u (b - a) + v (c - a) with a = (-1, -1), b = (1, -1), c = (1, 1).
    u, v = hit.rays[embree.HIT_U, 0], hit.rays[embree.HIT_V, 0]
    assert (-1 + 2 * u + 2 * v, -1 + 2 * v) == pytest.approx((0.5, -0.25), abs=1e-6)
    assert hit.rays[embree.NG_Z, 0] > 0


def test_a_ray_beside_the_triangle_misses() -> None:
    hit = shoot(Bvh(SQUARE, [Part(1, QUAD)]), [(1.01, 0, 3), (0, 0, -3)], [(0, 0, -1), (0, 0, -1)])
    assert hit.words[embree.GEOM, :2].tolist() == [-1, -1]


def test_masks_choose_what_a_ray_sees() -> None:
    """Glass at z = 1 in front of a wall at z = 0: each ray sees the nearest thing that its mask shares a bit with."""
    points = np.concatenate([square_at(0), square_at(1)])
    bvh = Bvh(points, [Part(int(embree.SOLID_STATIC), QUAD), Part(int(embree.REFRACTIVE), QUAD + np.uint32(4))])
    masks = [embree.OPAQUE, embree.REFRACTIVE, embree.EVERYTHING, embree.CUTOUT]
    hit = shoot(bvh, [(0.3, 0.2, 5)] * 4, [(0, 0, -1)] * 4, masks)
    assert hit.words[embree.GEOM, :4].tolist() == [0, 1, 1, -1]
    assert hit.rays[embree.T_FAR, :3].tolist() == pytest.approx([5, 4, 4], rel=1e-6)


def test_occlusion_obeys_masks_and_distance() -> None:
    bvh = Bvh(SQUARE, [Part(int(embree.SOLID_STATIC), QUAD)])
    packet = packet_of([(0, 0.1, 2)] * 3, [(0, 0, -1)] * 3, [embree.OPAQUE, embree.REFRACTIVE, embree.OPAQUE])
    packet.rays[embree.T_FAR, :3] = [math.inf, math.inf, 1.9]
    anything(Pointer(packet), bvh.handle, True)
    assert (packet.rays[embree.T_FAR, :3] < 0).tolist() == [True, False, False]


@pytest.mark.parametrize("radius", [0.01, 1.0, 250.0])
def test_a_sphere_is_exact_from_outside_and_inside(radius: float) -> None:
    """|o + t d - c| = r for both roots of the quadratic."""
    rng = np.random.default_rng(4)
    centre = np.array([0.3, -0.2, 0.7])
    d = rng.normal(size=(LANES, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    offset = rng.normal(size=(LANES, 3)) * radius * 0.3
    bvh = Bvh(np.zeros((0, 3), np.float32), [Part(1, None, (*centre, radius))])
    for start in (centre + offset - d * 3 * radius, centre + offset):
        hit = shoot(bvh, start, d)
        b = ((start - centre) * d).sum(1)
        root = np.sqrt(b * b - ((start - centre) ** 2).sum(1) + radius * radius)
        expected = np.where(-b - root > 0, -b - root, -b + root)
        np.testing.assert_allclose(hit.rays[embree.T_FAR], expected, rtol=2e-5)
        assert (hit.words[embree.GEOM] == 0).all()


def test_lanes_are_independent() -> None:
    """A lane's hit depends neither on its place in the packet nor on what the other lanes do."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32)
    bvh = Bvh(points, [Part(1, rng.integers(0, 300, (400, 3)).astype(np.uint32))])
    origins, directions = rng.uniform(-0.7, 0.7, (LANES, 3)), rng.normal(size=(LANES, 3))
    together = shoot(bvh, origins, directions)
    order = rng.permutation(LANES)
    mixed = shoot(bvh, origins[order], directions[order])
    hits = together.words[embree.PRIM]
    assert (hits >= 0).sum() >= 3  # the law is empty if nothing is hit
    assert (mixed.words[embree.PRIM] == hits[order]).all()
    for lane in range(LANES):
        alone = shoot(bvh, origins[lane : lane + 1], directions[lane : lane + 1])
        assert alone.words[embree.PRIM, 0] == hits[lane]
        assert alone.rays[embree.T_FAR, 0] == together.rays[embree.T_FAR, lane]


def test_inactive_lanes_are_left_alone_and_not_counted() -> None:
    packet = packet_of([(0, 0.1, 2)] * LANES, [(0, 0, -1)] * LANES)
    packet.valid[5:] = 0
    bvh = Bvh(SQUARE, [Part(1, QUAD)])
    nearest(Pointer(packet), bvh.handle, True)
    assert (packet.words[embree.GEOM] == [0] * 5 + [-1] * (LANES - 5)).all()
    assert np.isinf(packet.rays[embree.T_FAR, 5:]).all()
    assert packet.tally[0] == 5


def test_an_empty_scene_is_missed() -> None:
    hit = shoot(Bvh(np.zeros((0, 3), np.float32), []), [(0, 0, 0)], [(0, 0, 1)])
    assert hit.words[embree.GEOM, 0] == -1


def test_packets_are_aligned_as_embree_asks() -> None:
    """A packet of N rays and its valid mask stand on 4 N bytes (Embree 4 manual, rtcIntersect4/8/16)."""
    for packet in [Packet.fresh() for _ in range(20)]:
        assert packet.rays.ctypes.data % (4 * LANES) == 0
        assert packet.valid.ctypes.data % (4 * LANES) == 0


@pytest.mark.parametrize(
    ("points", "part", "word"),
    [
        (SQUARE, Part(1, QUAD + np.uint32(1)), "index"),
        (SQUARE, Part(1, QUAD.astype(np.int32) - 1), "index"),  # type: ignore[arg-type]
        (np.where(SQUARE == 1, np.nan, SQUARE).astype(np.float32), Part(1, QUAD), "NaN"),
        (np.where(SQUARE == 1, np.inf, SQUARE).astype(np.float32), Part(1, QUAD), "infinite"),
        (SQUARE[:, :2], Part(1, QUAD), "shape"),
        (SQUARE.astype(np.float64), Part(1, QUAD), "float32"),
        (SQUARE, Part(1, QUAD.reshape(3, 2)), "shape"),
        (SQUARE, Part(1, QUAD.astype(np.float32)), "integers"),
        (SQUARE, Part(1, None, (0, 0, 0, 0)), "radius"),
        (SQUARE, Part(1, None, (0, 0, math.nan, 1)), "finite"),
        (SQUARE, Part(1, None, (0, 0, 0, -1)), "radius"),
    ],
)
def test_malformed_arrays_are_refused_before_embree_sees_them(points: F32, part: Part, word: str) -> None:
    with pytest.raises(SceneError, match=word):
        Bvh(points, [part])


def test_handles_are_freed_with_the_object() -> None:
    bvh = Bvh(SQUARE, [Part(1, QUAD)])
    free = bvh._free
    assert free.alive
    del bvh
    gc.collect()
    assert not free.alive


def test_close_frees_once() -> None:
    bvh = Bvh(SQUARE, [Part(1, QUAD)])
    bvh.close()
    bvh.close()
    assert not bvh._free.alive


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the resident size from /proc")
def test_many_builds_do_not_grow_memory() -> None:
    """A leaked tree of 20 k triangles keeps more than 1 MB; sixty of them may not stay."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    rng = np.random.default_rng(6)
    points = rng.uniform(-1, 1, (10_000, 3)).astype(np.float32)
    triangles = rng.integers(0, 10_000, (20_000, 3)).astype(np.uint32)

    def build(times: int) -> None:
        for _ in range(times):
            Bvh(points, [Part(1, triangles)])

    build(5)
    before = resident()
    build(60)
    assert resident() - before < 40e6
