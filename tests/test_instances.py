"""What stands in many places looks as if every place had a mesh of its own."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from random_scenes import random_scene
from scenes import box, camera, constant_room, draw, glass, globe, light, material, quad, scene, turned

from refract_core.errors import SceneError
from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import LANES, by_address
from refract_core.probes.digest import probe_digest
from refract_core.probes.plan import plan_picture
from refract_core.scene import Instances, LightKind, Mesh, Model, Paths, Probe, Run, Scene, Source, Volume
from refract_core.world import embree
from refract_core.world.embree import Packet
from refract_core.world.instances import around, bounds_of, boxes, placed, settled
from refract_core.world.surface import Ray, hit_in, interaction, surface_of, thing_of
from refract_core.world.tables import pack_geometry

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


def place(rng: np.random.Generator, kind: str) -> F64:
    """A transform, shape (3, 4): turned, and scaled evenly, unevenly, or mirrored and askew."""
    linear = turned(rng.normal(size=3), rng.uniform(0, 360))
    if kind != "even":
        linear = linear @ np.diag(rng.uniform(0.5, 1.6, 3)) @ turned(rng.normal(size=3), rng.uniform(0, 360))
    if kind == "mirrored":
        linear = linear @ np.diag([1.0, -1.0, 1.0])
    return np.concatenate([linear, rng.uniform(-0.3, 0.3, (3, 1))], axis=1)


KINDS = ("even", "uneven", "mirrored")


def standing(mesh: Mesh, transform: F64, path: str) -> Mesh:
    """A mesh where a transform takes it, by the rules for vectors, normals and handedness."""
    linear, origin = transform[:, :3], transform[:, 3]
    order = [0, 1, 2] if np.linalg.det(linear) > 0 else [0, 2, 1]
    normals = mesh.normals
    if normals is not None:
        normals = np.linalg.solve(linear.T, normals.reshape(-1, 3).T.astype(np.float64)).T.reshape(normals.shape)
        normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True))[:, order].astype(np.float32)
    primvars = {name: v if v.shape[1] == 1 else v[:, order] for name, v in mesh.primvars.items()}
    points = (mesh.points @ linear.T + origin).astype(np.float32)
    triangles = mesh.triangles[:, order]
    return replace(mesh, path=path, points=points, triangles=triangles, normals=normals, primvars=primvars)


def both_ways(seed: int, copies: int = 2) -> tuple[Scene, Scene]:
    """A random scene without exact spheres, all of whose meshes stand in some places: as instances, and as meshes.

    The first place of each is where it was, in whatever frame its points are; the others are about it.
    """
    of = random_scene(seed, standing=False)
    rng = np.random.default_rng(seed)
    meshes: list[Mesh] = []
    instances = []
    for number, mesh in enumerate(of.meshes):
        frame = place(rng, KINDS[number % 3])
        square = np.vstack([frame, [0, 0, 0, 1]])
        local = standing(mesh, np.linalg.inv(square)[:3], mesh.path)
        wanted = [square]
        for k in range(copies - 1 if mesh.closed else 0):
            around = np.eye(4)
            around[:3, :3] = place(rng, KINDS[k % 3])[:, :3] * 0.6
            middle = mesh.points.mean(axis=0).astype(np.float64)
            around[:3, 3] = middle + rng.uniform(-0.5, 0.5, 3) - around[:3, :3] @ middle
            wanted.append(around @ square)
        transforms = np.array([one[:3] for one in wanted]).astype(np.float32)
        own = rng.uniform(0.1, 0.9, (len(wanted), 3)).astype(np.float32)
        # What an instance says goes for what its mesh does not say.
        primvars = {"three": own} if "three" not in local.primvars else {}
        paths = Paths((mesh.path, *([Run((f"{mesh.path}/[", "]/x"), np.arange(1, len(wanted), dtype=np.int32)[:, None])]
                                    if len(wanted) > 1 else [])))  # fmt: skip
        instances.append(Instances(local, transforms, paths, primvars))
        for k, (transform, path) in enumerate(zip(transforms.astype(np.float64), paths, strict=True)):
            one = standing(local, transform, path)
            said = {name: values[k].reshape(1, 1, -1) for name, values in primvars.items()}
            meshes.append(replace(one, primvars=one.primvars | said))
    return replace(of, meshes=(), spheres=(), instances=tuple(instances)), replace(of, meshes=tuple(meshes), spheres=())


def differing(a: dict[str, F32], b: dict[str, F32], tolerance: float = 2e-3) -> float:
    """Share of the pixels in which some plane differs."""
    assert a.keys() == b.keys()
    off = np.zeros(a["Z"].shape[:2], bool)
    for name in a:
        x, y = (np.nan_to_num(planes[name].astype(np.float64), posinf=1e9, neginf=-1e9) for planes in (a, b))
        near = np.abs(x - y) <= tolerance * (1.0 + np.abs(y))
        off |= ~near.reshape(*off.shape, -1).all(axis=2)
    return float(off.mean())


@pytest.mark.parametrize("seed", range(12))
def test_a_picture_of_instances_is_that_of_their_meshes(seed: int) -> None:
    """Opaque and glass of every model, cut-outs, textures, bent normals, mirrored and uneven places, links and shadows.
    Where a ray passes an edge within rounding it may go either way."""
    many, alone = both_ways(seed)
    a, b = (draw(of, 48, 36, max_layers=8) for of in (many, alone))
    assert differing(a, b) < 0.02
    assert np.abs(a["beauty"].mean(axis=(0, 1)) - b["beauty"].mean(axis=(0, 1))).max() < 2e-3


@pytest.mark.parametrize("seed", [1, 4])
def test_so_is_one_of_pixels_made_from_corners(seed: int) -> None:
    many, alone = both_ways(seed)
    a, b = (draw(of, 40, 30, samples=4) for of in (many, alone))
    assert differing(a, b, 1e-2) < 0.04


# --- single hits ------------------------------------------------------------------------------------------------------


@kernel
def look(packet, geometry, coherent, numbers, vectors):  # type: ignore[no-untyped-def]
    embree.intersect(packet, geometry.handle, coherent)
    for lane in range(LANES):
        numbers[lane, 0] = -1
        if embree.has_hit(packet, lane):
            hit = hit_in(packet, lane, geometry)
            ray = Ray(embree.ray_origin(packet, lane), embree.ray_direction(packet, lane))
            at = interaction(geometry, hit, ray, 0.0)
            numbers[lane, 0], numbers[lane, 1] = thing_of(geometry, hit), surface_of(geometry, hit)
            numbers[lane, 2], numbers[lane, 3] = hit.primitive, hit.material
            for c in range(3):
                vectors[lane, 0, c], vectors[lane, 1, c], vectors[lane, 2, c] = at.point[c], at.ng[c], at.ns[c]


def looked(of: Scene, origins: F64, directions: F64) -> tuple[NDArray[np.int64], F64]:
    """Of each ray: thing (-1 for none), surface, primitive, material; point, geometric and shading normal."""
    geometry, bvh, _ = pack_geometry(of)
    table, found, vectors = by_address(geometry), [], []
    for start in range(0, len(origins), LANES):
        packet = Packet.fresh()
        packet.rays[embree.ORG_X : embree.ORG_Z + 1] = origins[start : start + LANES].T
        packet.rays[embree.DIR_X : embree.DIR_Z + 1] = directions[start : start + LANES].T
        packet.rays[embree.T_FAR] = math.inf
        packet.words[embree.MASK], packet.words[embree.GEOM :] = -1, -1
        packet.valid[:] = -1
        numbers, places = np.zeros((LANES, 4), np.int64), np.zeros((LANES, 3, 3))
        look(by_address(packet), table, True, numbers, places)
        found.append(numbers)
        vectors.append(places)
    bvh.close()
    return np.concatenate(found), np.concatenate(vectors)


@pytest.mark.parametrize("seed", range(4))
def test_rays_meet_the_same_thing_and_normals(seed: int) -> None:
    many, alone = both_ways(seed, copies=3)
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-2, 2, (4096, 3))
    directions = rng.uniform(-0.7, 0.7, (4096, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    (a, p), (b, q) = (looked(of, origins, directions) for of in (many, alone))
    same = (a == b).all(axis=1)
    assert same.mean() > 0.998
    hit = same & (a[:, 0] >= 0)
    assert hit.sum() > 1000
    np.testing.assert_allclose(p[hit], q[hit], atol=2e-5)


def test_every_place_is_a_surface_and_a_thing_of_its_own() -> None:
    """Two balls of a mesh in front of each other: the far one has the next number."""
    many = Instances(globe("/ball", 0.2, 0), places((0, 0, 1), (0, 0, -1)), Paths(("/a", "/b")))
    of = replace(scene([quad("/floor", SQUARE, 0)], [material("/m")]), instances=(many,))
    numbers, _ = looked(of, np.array([[0.01, 0.02, 3.0], [0.01, 0.02, 0.5]] * 4), np.array([[0, 0, -1.0]] * 8))
    assert numbers[:2, 0].tolist() == [1, 2]
    assert numbers[:2, 1].tolist() == [1, 2]


SQUARE = [(-1, -1, -2), (1, -1, -2), (1, 1, -2), (-1, 1, -2)]


def places(*origins: tuple[float, float, float], scale: float = 1.0) -> F32:
    found = np.tile(np.eye(3, 4, dtype=np.float32) * scale, (len(origins), 1, 1))
    found[:, :, 3] = origins
    return found


# --- glass ------------------------------------------------------------------------------------------------------------


def test_each_instance_is_a_body_of_its_own() -> None:
    """Two slabs of one mesh, one of which the ray meets while in the other: it leaves each after its own thickness."""
    slab = box("/slab", (1.0, 1.0, 0.1), 1)
    walls, materials = constant_room()
    of = scene(walls, [*materials, glass(Model.TRACED, 1.0, TRANSMITTANCE=(0.5, 0.5, 0.5), absorption_distance=1.0)])
    apart = Instances(slab, places((0, 0, 0), (0, 0, 0.5)), Paths(("/a", "/b")))
    overlapping = Instances(slab, places((0, 0, 0), (0, 0, 0.1)), Paths(("/a", "/b")))
    for many, length in ((apart, 0.4), (overlapping, 0.3)):
        planes = draw(replace(of, instances=(many,)), 8, 8)
        at = planes["beauty"][3:5, 3:5, 0].mean()
        assert at == pytest.approx(0.5**length, rel=2e-3)


def test_absorption_is_by_metres_of_the_world() -> None:
    """The same ball twice as large absorbs as a mesh of twice the size."""
    walls, materials = constant_room()
    tinted = glass(Model.TRACED, 1.0, TRANSMITTANCE=(0.3, 0.6, 0.9), absorption_distance=0.5)
    of = scene(walls, [*materials, tinted])
    many = Instances(globe("/ball", 0.25, 1, 24), places((0, 0, 0), scale=2.0), Paths(("/ball",)))
    a = draw(replace(of, instances=(many,)), 16, 16)
    b = draw(replace(of, meshes=(*of.meshes, globe("/ball", 0.5, 1, 24))), 16, 16)
    np.testing.assert_allclose(a["beauty"], b["beauty"], atol=2e-5)


def test_an_eye_in_an_instance_is_in_glass() -> None:
    many, alone = both_ways_around_the_eye()
    assert differing(draw(many, 24, 24), draw(alone, 24, 24)) < 0.01


def both_ways_around_the_eye() -> tuple[Scene, Scene]:
    walls, materials = constant_room()
    tinted = glass(Model.TRACED, 1.4, TRANSMITTANCE=(0.3, 0.6, 0.9), absorption_distance=0.5)
    of = scene(walls, [*materials, tinted])
    local = box("/box", (0.5, 0.5, 0.5), 1)
    many = Instances(local, places((3, 0, 0), (0, 0, 2.5)), Paths(("/a", "/b")))
    return replace(of, instances=(many,)), replace(of, meshes=(*of.meshes, placed(many, 0), placed(many, 1)))


def test_photons_start_from_every_place() -> None:
    """Light that falls through lenses lands under each of them, and is as much as of meshes."""
    lens = globe("/lens", 0.15, 1, 16)
    white = material("/white", DIFFUSE=0.8)
    floor = quad("/floor", [(-2, -0.8, 2), (2, -0.8, 2), (2, -0.8, -2), (-2, -0.8, -2)], 0)
    at = [(-0.5, 0, 0), (0.5, 0, 0.2), (0.1, 0.2, -0.5)]
    lamp = light(LightKind.SPHERE, (0, 2.5, 0), (0, -1, 0), (0.05, 0.0), 100.0)
    of = scene([floor], [white, glass(Model.TRACED, 1.5)], lights=(lamp,), cameras=(camera((0, 2, 3)),))
    many = Instances(lens, places(*at), Paths(("/a", "/b", "/c")))
    mirrored = replace(many, transforms=many.transforms * np.array([[-1], [1], [1]], np.float32))
    mirrored.transforms[:, 0, 3] *= -1
    meshes = tuple(placed(many, k) for k in range(3))
    settings: dict[str, Any] = {"samples": 4, "caustics": 1 << 16}
    b = draw(replace(of, meshes=(floor, *meshes)), 64, 64, **settings)["beauty"]
    for one in (many, mirrored):
        a = draw(replace(of, instances=(one,)), 64, 64, **settings)["beauty"]
        assert a.mean() == pytest.approx(b.mean(), rel=0.02)
        assert np.abs(blurred(a) - blurred(b)).max() < 0.15 * blurred(b).max()


def blurred(picture: F32) -> F64:
    """Means over 8x8 pixels."""
    h, w = picture.shape[:2]
    return picture[..., :3].astype(np.float64).reshape(h // 8, 8, w // 8, 8, 3).mean(axis=(1, 3))


# --- light, probes, collections ---------------------------------------------------------------------------------------


def test_what_glows_in_many_places_lights_the_scene() -> None:
    bulb = globe("/bulb", 0.05, 1, 6)
    floor = quad("/floor", [(-2, -0.5, 2), (2, -0.5, 2), (2, -0.5, -2), (-2, -0.5, -2)], 0)
    materials = [material("/white", DIFFUSE=0.8), material("/bulb", EMISSIVE=20.0)]
    of = scene([floor], materials, cameras=(camera((0, 2, 3)),))
    many = Instances(bulb, places((-0.5, 0, 0), (0.5, 0, 0.2)), Paths(("/a", "/b")))
    a = draw(replace(of, instances=(many,)), emission_light=True)
    b = draw(replace(of, meshes=(floor, placed(many, 0), placed(many, 1))), emission_light=True)
    assert b["beauty"][..., 0].mean() > 0.03
    np.testing.assert_array_equal(a["beauty"], b["beauty"])


@pytest.mark.parametrize("collection", ["lit", "casters"])
def test_links_tell_instances_apart(collection: str) -> None:
    """A light that one of two boxes is linked to, and casts shadows by one of them."""
    floor = quad("/floor", [(-2, -0.5, 2), (2, -0.5, 2), (2, -0.5, -2), (-2, -0.5, -2)], 0)
    lamp = light(LightKind.SPHERE, (0, 2.5, 1), (0, -1, -0.4), (0.05, 0.0), 100.0)
    linked: dict[str, Any] = {collection: ("/floor", "/b")}
    of = scene([floor], [material("/white", DIFFUSE=0.8)], lights=(lamp,), cameras=(camera((0, 2, 3)),))
    linked_of = replace(of, lights=(replace(lamp, **linked),))
    many = Instances(box("/box", (0.2, 0.2, 0.2), 0), places((-0.5, 0, 0), (0.5, 0, 0)), Paths(("/a", "/b")))
    a = draw(replace(linked_of, instances=(many,)))
    b = draw(replace(linked_of, meshes=(floor, placed(many, 0), placed(many, 1))))
    c = draw(replace(of, instances=(many,)))
    assert differing(a, b) < 0.003 < differing(a, c)


def test_probes_serve_instances_and_leave_out_what_they_do_not_capture() -> None:
    floor = quad("/floor", SQUARE, 0)
    of = scene([floor], [material("/m"), glass(Model.SPHERE)])
    many = Instances(globe("/ball", 0.2, 1), places((0, 0, 0), (5, 0, 0)), Paths(("/a", "/b")))
    near = Volume(np.eye(4), False, (1.0, 1.0, 1.0))
    probe = Probe("/probe", "realtime", (0.0, 0.0, 0.0), near, near, resolution=8, captured=("/a", "/floor"))
    of = replace(of, instances=(many,), probes=(probe,))
    chosen = plan_picture(of, of.cameras[0], drawn=True, proxies=False)
    assert chosen.thing_probe.tolist() == [-1, 0, -1]
    assert len(settled(of).instances) == 2


def test_a_digest_does_not_hang_on_the_order_of_places_but_on_each() -> None:
    box_at = Volume(np.eye(4), False, (1.0, 1.0, 1.0))
    probe = Probe("/probe", "baked", (0.0, 0.0, 0.0), box_at, box_at)
    of = scene([quad("/floor", SQUARE, 0)], [material("/m", DIFFUSE=0.5)], probes=(probe,))

    def digest(transforms: F32) -> str:
        many = Instances(globe("/ball", 0.2, 0), transforms, Paths(("/a", "/b")))
        return probe_digest(replace(of, instances=(many,)), probe)

    first = digest(places((0, 0, 0), (5, 0, 0)))
    assert digest(places((5, 0, 0), (0, 0, 0))) == first != digest(places((5, 0, 0), (0, 0, 1e-3)))


def test_a_digest_does_not_hang_on_what_the_glass_of_places_reads() -> None:
    """Of a mesh that is partly glass, each place has a colour for the glass and one for the rest."""
    box_at = Volume(np.eye(4), False, (1.0, 1.0, 1.0))
    probe = Probe("/probe", "baked", (0.0, 0.0, 0.0), box_at, box_at)
    painted = material("/painted", DIFFUSE=Source(primvar="paint"))
    stained = glass(Model.TRACED, DIFFUSE=Source(primvar="stain"))
    ball = globe("/ball", 0.2, 0)
    ball.materials[::2] = 1
    of = scene([quad("/floor", SQUARE, 0)], [painted, stained])

    def digest(**primvars: F32) -> str:
        many = Instances(ball, places((0, 0, 0), (5, 0, 0)), Paths(("/a", "/b")), primvars)
        return probe_digest(replace(of, instances=(many,)), probe)

    one, other = np.full((2, 3), 0.5, np.float32), np.full((2, 3), 0.7, np.float32)
    assert digest(paint=one, stain=one) == digest(paint=one, stain=other) != digest(paint=other, stain=one)


# --- records ----------------------------------------------------------------------------------------------------------


def test_paths_are_written_when_asked_for() -> None:
    numbers = np.array([[0, 7], [3, 8]], np.int32)
    paths = Paths(("/a", Run(("/P/[", "]/Q/[", "]/x"), numbers), "/b"))
    written = ["/a", "/P/[0]/Q/[7]/x", "/P/[3]/Q/[8]/x", "/b"]
    assert list(paths) == written == [paths[k] for k in range(4)] == paths[:]
    assert paths[-1] == "/b"
    assert list(paths.owners()) == [("/a", 1), ("/P", 2), ("/b", 1)]
    assert list(paths.take(np.array([0, 2, 3]))) == ["/a", "/P/[3]/Q/[8]/x", "/b"]
    assert list(pickle.loads(pickle.dumps(paths))) == written
    with pytest.raises(IndexError):
        paths[4]


def test_bounds_hold_all_and_boxes_each() -> None:
    rng = np.random.default_rng(3)
    transforms = np.array([place(rng, KINDS[k % 3]) for k in range(9)], np.float32)
    many = Instances(globe("/ball", 0.2, 0), transforms, Paths(tuple(f"/{k}" for k in range(9))))
    low, high = boxes(many, many.mesh.points.astype(np.float64))
    for k in range(9):
        points = placed(many, k).points
        np.testing.assert_allclose([low[k], high[k]], [points.min(0), points.max(0)], atol=1e-6)
    outer = bounds_of(many)
    assert (outer[0] <= low + 1e-9).all()
    assert (outer[1] >= high - 1e-9).all()


def test_what_is_around_a_point() -> None:
    rng = np.random.default_rng(5)
    transforms = np.array([place(rng, KINDS[k % 3]) for k in range(30)], np.float32)
    many = Instances(globe("/ball", 0.3, 0, 24), transforms, Paths(tuple(f"/{k}" for k in range(30))))
    at = (0.1, 0.05, -0.1)
    # A globe of 24 steps is a ball to 1 %.
    local = [np.linalg.solve(t[:, :3].astype(np.float64), at - t[:, 3]) for t in transforms]
    sure = [k for k, p in enumerate(local) if np.linalg.norm(p) < 0.295]
    maybe = [k for k, p in enumerate(local) if np.linalg.norm(p) < 0.301]
    assert 0 < len(sure) < 30
    assert set(sure) <= set(around(many, at)) <= set(maybe)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"transforms": np.zeros((2, 3, 4), np.float32)}, "flattens"),
        ({"transforms": np.full((2, 3, 4), np.nan, np.float32)}, "not finite"),
        ({"transforms": np.zeros((2, 4, 4), np.float32)}, "shape"),
        ({"paths": Paths(("/a",))}, "2 transforms but 1 paths"),
        ({"primvars": {"x": np.zeros((1, 3), np.float32)}}, "primvar x"),
    ],
)
def test_what_breaks_the_contract_is_refused(fields: dict[str, Any], words: str) -> None:
    many = replace(Instances(globe("/ball", 0.2, 0), places((0, 0, 0), (1, 0, 0)), Paths(("/a", "/b"))), **fields)
    with pytest.raises(SceneError, match=words):
        pack_geometry(replace(scene([quad("/floor", SQUARE, 0)], [material("/m")]), instances=(many,)))


def test_a_mesh_in_many_places_is_in_the_tables_once() -> None:
    """Of instances with other materials the hierarchy is the same one, and of those with the same all rows are."""
    ball = globe("/ball", 0.2, 0)
    other = replace(ball, materials=np.ones(len(ball.materials), np.int32))
    of = replace(
        scene([quad("/floor", SQUARE, 0)], [material("/m"), glass(Model.TRACED)]),
        instances=tuple(
            Instances(mesh, places(at), Paths((f"/{k}",)))
            for k, (mesh, at) in enumerate([(ball, (0, 0, 0)), (ball, (1, 0, 0)), (other, (0, 1, 0))])
        ),
    )
    geometry, bvh, _ = pack_geometry(of)
    assert len(geometry.points) == 4 + len(ball.points)
    assert geometry.first[1] == geometry.first[2] != geometry.first[3]
    bvh.close()


def test_what_places_say_is_in_the_tables_once() -> None:
    """Of a mesh that is partly glass, too, which is two parts."""
    ball = globe("/ball", 0.2, 0)
    ball.materials[::2] = 1
    own = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], np.float32)
    many = Instances(ball, places((0, 0, 0), (1, 0, 0)), Paths(("/a", "/b")), {"paint": own})
    painted = Source(primvar="paint")
    of = scene([quad("/floor", SQUARE, 0)], [material("/m", DIFFUSE=painted), glass(Model.TRACED, DIFFUSE=painted)])
    geometry, bvh, _ = pack_geometry(replace(of, instances=(many,)))
    assert geometry.primvars.tolist() == own.ravel().tolist()
    assert geometry.primvar_first[:, 0].tolist() == [-1, 0, 0]
    bvh.close()


