"""A probe's digest changes with everything its picture shows, and with nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import box, dome, glass, material, quad
from scenes import light as light_at

from refract_core.probes import digest
from refract_core.probes.digest import probe_digest
from refract_core.scene import (
    Bake,
    Cubemap,
    Environment,
    Light,
    LightKind,
    Mesh,
    Model,
    Param,
    Probe,
    Scene,
    Source,
    Sphere,
    Texture,
    Volume,
)

PICTURE = np.random.default_rng(0).integers(0, 256, (8, 8, 4), np.uint8)
VOLUME = Volume(np.eye(4), False, (5.0, 5.0, 5.0))
PROBE = Probe("/Probe", "baked", (0.0, 1.0, 0.0), VOLUME, VOLUME)


def light() -> Light:
    return light_at(LightKind.RECT, (0.0, 3.0, 0.0), (0.0, -1.0, 0.01), (1.0, 2.0))


def world() -> Scene:
    """A floor with a picture on it, a red box, a ball, a moving box, and a glass box."""
    picture = Source(texture=0, uv_primvar="st")
    materials = (
        material("/floor", DIFFUSE=picture),
        material("/red", DIFFUSE=(0.8, 0.1, 0.1)),
        glass(Model.TRACED),
        material("/painted", DIFFUSE=Source(primvar="displayColor")),
    )
    floor = quad("/Floor", [[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]])
    moving = replace(box("/Moving", (0.2,) * 3, 1, centre=(0, 1, 2)), static=False)
    ball = Sphere("/Ball", (2.0, 1.0, 0.0), 0.5, 3, {"displayColor": np.full((1, 1, 3), 0.3, np.float32)})
    return Scene(
        meshes=(floor, box("/Box", (0.5,) * 3, 1), moving, box("/Glass", (0.3,) * 3, 2, centre=(1, 1, 1))),
        materials=materials,
        spheres=(ball,),
        textures=(Texture("/tmp/a.png", PICTURE, True),),
        lights=(light(),),
        environment=dome(0.5),
        probes=(PROBE,),
    )


def mesh_changed(path: str, **fields: Any) -> Scene:
    scene = world()
    return replace(scene, meshes=tuple(replace(m, **fields) if m.path == path else m for m in scene.meshes))


def material_changed(index: int, **fields: Any) -> Scene:
    scene = world()
    rows = list(scene.materials)
    rows[index] = replace(rows[index], **fields)
    return replace(scene, materials=tuple(rows))


def input_changed(index: int, param: Param, **fields: Any) -> Scene:
    inputs = list(world().materials[index].inputs)
    inputs[param] = replace(inputs[param], **fields)
    return material_changed(index, inputs=tuple(inputs))


def texture_changed() -> Scene:
    pixels = PICTURE.copy()
    pixels[3, 4, 0] ^= 1
    return replace(world(), textures=(Texture("/tmp/a.png", pixels, True),))


def moved(points: Any, by: float = 1e-3) -> Any:
    shifted = points.copy()
    shifted[0, 0] += by
    return shifted


WHITE = {"displayColor": np.ones((1, 1, 3), np.float32)}
BOX = box("/Box", (0.5,) * 3, 1)
BEFORE = probe_digest(world(), PROBE)

SEEN: dict[str, Callable[[], tuple[Scene, Probe]]] = {
    "a point": lambda: (mesh_changed("/Box", points=moved(BOX.points)), PROBE),
    "winding": lambda: (mesh_changed("/Box", triangles=BOX.triangles[:, ::-1].copy()), PROBE),
    "normals": lambda: (mesh_changed("/Box", normals=np.ones((12, 3, 3), np.float32)), PROBE),
    "double-sided": lambda: (mesh_changed("/Box", double_sided=True), PROBE),
    "binding": lambda: (mesh_changed("/Box", materials=np.full(12, 3, np.int32)), PROBE),
    "one face's binding": lambda: (mesh_changed("/Box", materials=np.array([3] + [1] * 11, np.int32)), PROBE),
    "a thing that stands still now": lambda: (mesh_changed("/Moving", static=True), PROBE),
    "a thing that moves now": lambda: (mesh_changed("/Box", static=False), PROBE),
    "glass that is opaque now": lambda: (mesh_changed("/Glass", materials=np.full(12, 1, np.int32)), PROBE),
    "uv": lambda: (mesh_changed("/Floor", primvars={"st": world().meshes[0].primvars["st"] * 2}), PROBE),
    "colour": lambda: (input_changed(1, Param.DIFFUSE, value=(0.8, 0.1, 0.2, 1.0)), PROBE),
    "gloss": lambda: (input_changed(1, Param.ROUGHNESS, value=(0.5,) * 4), PROBE),
    "wrap": lambda: (input_changed(0, Param.DIFFUSE, scale=(2.0, 1.0, 1.0, 1.0)), PROBE),
    "cutout": lambda: (material_changed(1, opacity_threshold=0.5), PROBE),
    "a texel": lambda: (texture_changed(), PROBE),
    "colour space": lambda: (replace(world(), textures=(Texture("/tmp/a.png", PICTURE, False),)), PROBE),
    "light": lambda: (replace(world(), lights=(replace(light(), radiance=(9.0, 9.0, 9.0)),)), PROBE),
    "a second light": lambda: (replace(world(), lights=(light(), light())), PROBE),
    "no light": lambda: (replace(world(), lights=()), PROBE),
    "camera light": lambda: (replace(world(), camera_light=True), PROBE),
    "dome": lambda: (replace(world(), environment=dome(0.6)), PROBE),
    "turned dome": lambda: (replace(world(), environment=Environment(dome(0.5).pixels, np.eye(3)[::-1])), PROBE),
    "no dome": lambda: (replace(world(), environment=None), PROBE),
    "ball": lambda: (replace(world(), spheres=(replace(world().spheres[0], radius=0.6),)), PROBE),
    "ball's paint": lambda: (replace(world(), spheres=(replace(world().spheres[0], primvars=WHITE),)), PROBE),
    "capture point": lambda: (world(), replace(PROBE, capture_point=(0.0, 1.1, 0.0))),
    "clipping": lambda: (world(), replace(PROBE, clipping=(0.2, 1000.0))),
    "resolution": lambda: (world(), replace(PROBE, resolution=256)),
    "background": lambda: (world(), replace(PROBE, background=(0.0, 0.0, 0.0))),
    "captured": lambda: (world(), replace(PROBE, captured=("/Floor",))),
    "realtime": lambda: (world(), replace(PROBE, mode="realtime")),
}  # fmt: skip


@pytest.mark.parametrize("what", SEEN)
def test_it_changes_with_what_is_seen(what: str) -> None:
    assert probe_digest(*SEEN[what]()) != BEFORE


def renamed() -> Scene:
    """The same world under other names, read in another order."""
    scene = world()
    order = [3, 1, 0, 2]
    row = {old: new for new, old in enumerate(order)}
    meshes = [
        replace(m, path=f"/New{m.path}", materials=np.array([row[int(k)] for k in m.materials], np.int32))
        for m in reversed(scene.meshes)
    ]
    return replace(
        scene,
        name="elsewhere.usda",
        meshes=tuple(meshes),
        materials=tuple(replace(scene.materials[old], name=f"/New{old}") for old in order),
        spheres=tuple(replace(ball, path="/Marble", material=row[ball.material]) for ball in scene.spheres),
        textures=tuple(replace(texture, name="elsewhere.png") for texture in scene.textures),
        lights=tuple(replace(one, path="/Sun") for one in scene.lights),
        time_code=7.0,
    )


CUBEMAP = Cubemap((np.zeros((6, 128, 128, 5), np.float32),))
UNSEEN: dict[str, Callable[[], tuple[Scene, Probe]]] = {
    "nothing": lambda: (world(), PROBE),
    "names and order": lambda: (renamed(), replace(PROBE, path="/Elsewhere")),
    "moved glass": lambda: (mesh_changed("/Glass", points=moved(world().meshes[3].points)), PROBE),
    "another glass": lambda: (material_changed(2, abbe=30.0, model=Model.THIN), PROBE),
    "no glass": lambda: (replace(world(), meshes=world().meshes[:3]), PROBE),
    "a moving thing": lambda: (mesh_changed("/Moving", points=moved(world().meshes[2].points)), PROBE),
    "unused primvar": lambda: (mesh_changed("/Box", primvars={"temperature": np.ones((1, 1, 1), np.float32)}), PROBE),
    "unused material": lambda: (replace(world(), materials=(*world().materials, material("/spare"))), PROBE),
    "unused texture": lambda: (replace(world(), textures=(*world().textures, Texture("b", PICTURE))), PROBE),
    "thickness": lambda: (input_changed(1, Param.THICKNESS, value=(3.0,) * 4), PROBE),
    "influence": lambda: (world(), replace(PROBE, influence=Volume(np.eye(4), True, (1.0,) * 3))),
    "proxy": lambda: (world(), replace(PROBE, proxy=None)),
    "blending": lambda: (world(), replace(PROBE, weight=0.5, importance=3, multiplier=2.0, blend_distance=(1.0,) * 6)),
    "its picture": lambda: (world(), replace(PROBE, cubemap=CUBEMAP, bake=Bake("0", "0.0", 1.0))),
    "all of it captured": lambda: (world(), replace(PROBE, captured=("/Floor", "/Box", "/Ball", "/Moving", "/Glass"))),
    "custom": lambda: (world(), replace(PROBE, mode="custom")),
}


@pytest.mark.parametrize("what", UNSEEN)
def test_it_stays_with_what_is_not_seen(what: str) -> None:
    assert probe_digest(*UNSEEN[what]()) == BEFORE


def test_it_is_a_sha256_in_hex() -> None:
    assert len(BEFORE) == 64
    assert int(BEFORE, 16) > 0


def test_an_instance_belongs_to_its_instancer() -> None:
    scene = world()
    many = replace(scene, meshes=tuple(replace(m, path=f"/Many/[{i}]/Box") for i, m in enumerate(scene.meshes)))
    assert probe_digest(many, replace(PROBE, captured=("/Many", "/Ball"))) == BEFORE


def both_kinds(glass_half: float) -> Mesh:
    """One mesh whose first six triangles are painted and whose other six are glass."""
    mesh = box("/Both", (0.5,) * 3, 1)
    points = mesh.points.copy()
    halves = np.concatenate([points[mesh.triangles[:6]].reshape(-1, 3), points[mesh.triangles[6:]].reshape(-1, 3)])
    halves[18:] *= glass_half
    triangles = np.arange(36, dtype=np.uint32).reshape(12, 3)
    return replace(mesh, points=halves, triangles=triangles, materials=np.array([1] * 6 + [2] * 6, np.int32))


def test_the_glass_faces_of_a_mesh_do_not_count() -> None:
    one, other = (probe_digest(replace(world(), meshes=(both_kinds(half),)), PROBE) for half in (1.0, 0.7))
    assert one == other
    painted = replace(both_kinds(1.0), materials=np.array([3] * 6 + [2] * 6, np.int32))
    assert probe_digest(replace(world(), meshes=(painted,)), PROBE) != one


def test_an_empty_scene_has_a_digest() -> None:
    empty = Scene(meshes=(), materials=())
    assert probe_digest(empty, PROBE) != BEFORE
    assert probe_digest(empty, PROBE) == probe_digest(Scene(meshes=(), materials=()), PROBE)


def test_big_things_are_hashed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """256 probes in a large scene must not cost 256 times the scene."""
    hashed: list[str] = []

    def counted(name: str) -> Callable[[Any], bytes]:
        real: Callable[[Any], bytes] = getattr(digest, name)

        def count(record: Any) -> bytes:
            hashed.append(name)
            return real(record)

        return count

    for name in ("_texture", "_geometry", "_environment"):
        monkeypatch.setattr(digest, name, counted(name))
    scene = world()
    for x in range(5):
        probe_digest(scene, replace(PROBE, capture_point=(float(x), 0.0, 0.0)))
    assert hashed.count("_texture") == 1
    assert hashed.count("_environment") == 1
    assert hashed.count("_geometry") == 2


def test_memory_is_given_back() -> None:
    def once() -> int:
        scene = world()
        probe_digest(scene, PROBE)
        return len(digest._known)

    before = len(digest._known)
    assert once() > before
    assert len(digest._known) == before
