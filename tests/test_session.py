"""A session: the same pictures bit by bit, whatever was changed between them, and only that made anew."""

from __future__ import annotations

import gc
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import box, camera, checker_room, glass, light, material, quad, scene
from test_planar import window
from test_probes import probe, volume

import refract_core as rc
from refract_core.errors import Cancelled, SceneError
from refract_core.images.frame import Frame
from refract_core.progress import Report
from refract_core.rendering import ready as room
from refract_core.rendering.picture import glass_over
from refract_core.rendering.ready import Ready, prepare
from refract_core.rendering.session import same
from refract_core.rendering.work import Work
from refract_core.scene import Environment, LightKind, Model, Param, Scene, Source, Sphere
from refract_core.settings import QUALITIES, RenderSettings
from refract_core.verbs.compare_renders import CompareOrder, compare_stage
from refract_core.verbs.render_files import Order, render_files
from refract_core.world import environment, textures

pytestmark = pytest.mark.draws

SAMPLES = Path(__file__).parents[1] / "usd_samples" / "good"
SMALL = RenderSettings(image_width=24, image_height=16, samples=4, jobs=1, caustics=256)
GLASS, BLOCK = 6, 7
"""Rows of `busy` in the material table."""


def noise(*shape: int, seed: int = 1) -> NDArray[np.float32]:
    return np.random.default_rng(seed).random(shape, np.float32)


def busy() -> Scene:
    """One of everything: a ball and a slab of glass in a room of textures, a block, a lamp, a sky, and probes of all
    kinds. Built anew at each call, so that nobody shares an array with another."""
    walls, materials, checkers = checker_room()
    images = tuple(replace(t, pixels=noise(16, 32, 4, seed=k)) for k, t in enumerate(checkers))
    place = Source(primvar="place", value=(0.2, 0.3, 0.4, 1.0))
    thickness = Source(primvar="thick", value=(1.0, 1.0, 1.0, 1.0))
    block = replace(
        box("/block", (0.3, 0.5, 0.2), BLOCK, centre=(-0.9, -0.7, -1.0)),
        primvars={"place": noise(12, 3, 3)},
        static=False,
    )
    block = replace(block, normals=np.tile(np.array([0.0, 0.6, 0.8], np.float32), (12, 3, 1)))
    slab = quad("/slab", [(-1, -1, 1.2), (1, -1, 1.2), (1, 1, 1.2), (-1, 1, 1.2)], GLASS)
    square = replace(window(np.eye(4)[:3, :3], (1.0, 1.0, 0.3)), resolution=8)
    probes = (
        replace(square, path="/probes/window", capture_point=(0.0, 0.0, 1.2)),
        probe((0.1, 0.2, 0.3), path="/probes/baked", resolution=8, influence=volume(2.0), marched=True),
        probe((0.2, 0.1, 0.3), path="/probes/seeing", resolution=8, mode="realtime", sees_glass=True, importance=2,
              influence=volume(1.0)),
        probe((0.3, 0.1, 0.2), path="/probes/some", resolution=8, mode="realtime", captured=("/wall1", "/block")),
    )  # fmt: skip
    return scene(
        [*(wall for i, wall in enumerate(walls) if i != 2), block, slab],
        [*materials, glass(Model.SPHERE, 1.4, ROUGHNESS=0.1, THICKNESS=thickness), material("/block", DIFFUSE=place)],
        [Sphere("/ball", (0.3, -0.2, 0.1), 0.6, GLASS, {"thick": np.full((1, 1, 1), 0.4, np.float32)}),
         Sphere("/stone", (1.2, -0.5, 0.3), 0.3, BLOCK)],
        textures=images, lights=(light(LightKind.RECT, (0.5, 2.5, 0.2), (0.1, -1, 0.2), (0.8, 0.5), 4.0),),
        environment=Environment(noise(16, 32, 3)), probes=probes,
        cameras=(camera(), camera((1.5, 0.4, 2.0), (0.2, 0.0, 0.0))),
    )  # fmt: skip


def bits(frame: Frame) -> dict[str, Any]:
    """All there is in a frame, so that `==` means equal to the last bit."""
    return {
        **{name: plane.tobytes() for name, plane in frame.planes.items()},
        "metadata": frame.metadata,
        "notices": frame.notices,
    }


def ready_bits(ready: Ready) -> list[bytes]:
    """The tables of a scene made ready, and the picture-data of its probes."""
    found: list[bytes] = []

    def walk(value: Any, name: str = "") -> None:
        if isinstance(value, np.ndarray):
            found.append(f"{value.dtype}{value.shape}".encode() + value.tobytes())
        elif isinstance(value, tuple):
            for inner, field in zip(value, getattr(value, "_fields", [""] * len(value)), strict=True):
                walk(inner, field)
        elif name != "handle":
            found.append(repr(value).encode())

    world: Any = ready.world  # by address; the record is behind it
    walk((world.record, ready.probes, ready.thing_probe, ready.rays, ready.notices))
    return found


def made_ready(what: Scene, session: rc.Session | None = None, settings: RenderSettings = SMALL) -> Ready:
    """As `render` makes it."""
    lens = what.cameras[0]
    with ThreadPoolExecutor(1) as executor:
        work = Work(executor, lambda _share, _stage: None, lambda: False)
        return prepare(what, lens, settings, work, glass_over(what, lens, settings, work), session)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each part is made from now on; probes by their paths."""
    counter: Counter[str] = Counter()

    def count(holder: Any, name: str, what: Callable[..., Sequence[str]]) -> None:
        before = getattr(holder, name)

        def counting(*args: Any, **more: Any) -> Any:
            counter.update(what(*args))
            return before(*args, **more)

        monkeypatch.setattr(holder, name, counting)

    count(room, "pack_geometry", lambda *_: ["geometry"])
    count(textures, "pack", lambda *_: ["textures"])
    count(environment, "pack", lambda *_: ["environment"])
    count(room, "fill_table", lambda _table, entries, *_: [entry.probe.path for entry in entries])
    return counter


# --- the same pictures --------------------------------------------------------------------------------------------


def sequence() -> Iterator[tuple[str, Scene, RenderSettings]]:
    """What a person does with a stage, each step from the scene of the one before, and back again."""
    base = busy()
    yield "first", base, SMALL
    yield "again", busy(), SMALL
    yield "another camera", replace(base, cameras=base.cameras[::-1]), SMALL
    yield "other glass", rc.override(base, {"/glass": {"ior": 1.7, "model": "box"}}), SMALL
    yield "thick glass", thick(base, "thick"), SMALL
    yield "thickness by another name", thick(base, "first"), SMALL
    yield "smooth glass", rc.override(base, {"/glass": {"roughness": 0.0}}), SMALL
    brighter = replace(base.lights[0], radiance=(1.0, 2.0, 9.0))
    yield "another light", replace(base, lights=(brighter,)), SMALL
    yield "no light", replace(base, lights=(), environment=None, camera_light=True), SMALL
    moved = [replace(m, points=m.points + np.float32(0.1)) if m.path == "/block" else m for m in base.meshes]
    yield "another time", replace(base, meshes=tuple(moved), time_code=2.0), SMALL
    yield "another quality", base, replace(SMALL, **QUALITIES["draft"])
    yield "more samples", base, replace(SMALL, samples=16)
    yield "no probes asked", base, replace(SMALL, tiers=("ray", "sky"))
    yield "proxies", base, replace(SMALL, screen="proxy", samples=1)
    yield "exposed", base, replace(SMALL, exposure=1.5)
    yield "back again", busy(), SMALL


def test_pictures_are_the_same_with_and_without() -> None:
    session = rc.Session()
    for what, each, settings in sequence():
        assert bits(rc.render(each, settings, session=session)) == bits(rc.render(each, settings)), what


@pytest.mark.parametrize("name", ["marble", "baked_and_realtime"])
def test_frames_of_a_stage_are_the_same(name: str) -> None:
    session, small = rc.Session(), replace(SMALL, samples=1)
    for when in (0.0, 12.0, 0.0):
        what = rc.load_stage(SAMPLES / f"{name}.usda", time_code=when)
        what = replace(what, probes=tuple(replace(one, resolution=8) for one in what.probes))
        assert bits(rc.render(what, small, session=session)) == bits(rc.render(what, small))


def changed(value: Any) -> Any:
    """Something else of the same type that is valid where `value` was; the same where nothing can be told."""
    match value:
        case np.ndarray():
            return value[::-1].copy()
        case bool():
            return not value
        case float():
            return value * 0.75 + 0.01
        case str():
            return f"{value}_"
        case dict():
            return {name: changed(each) for name, each in value.items()}
        case tuple() if value and isinstance(value[0], float):
            return tuple(changed(each) for each in value)
    return value


def variants() -> Iterator[Any]:
    """The busy scene with one field of one of its records changed, for every field there is."""
    base = busy()
    records: dict[str, dict[int, Any]] = {
        "meshes": {0: base.meshes[0], 5: base.meshes[5]}, "spheres": {0: base.spheres[0], 1: base.spheres[1]},
        "materials": {0: base.materials[0], GLASS: base.materials[GLASS], BLOCK: base.materials[BLOCK]},
        "textures": {1: base.textures[1]}, "lights": {0: base.lights[0]}, "probes": dict(enumerate(base.probes)),
        "cameras": {0: base.cameras[0]},
    }  # fmt: skip
    for group, some in records.items():
        for row, record in some.items():
            for field in fields(record):
                def one(old: Any, field: Any = field) -> Any:
                    return replace(old, **{field.name: changed(getattr(old, field.name))})

                yield pytest.param(group, row, one, id=f"{group}[{row}].{field.name}")
    for row in (0, GLASS, BLOCK):
        for param, name in product(Param, ("value", "scale") if row == 0 else ("value",)):
            def one_input(old: Any, param: Param = param, name: str = name) -> Any:
                source = replace(old.inputs[param], **{name: changed(getattr(old.inputs[param], name))})
                return replace(old, inputs=(*old.inputs[:param], source, *old.inputs[param + 1 :]))

            yield pytest.param("materials", row, one_input, id=f"materials[{row}].{param.name}.{name}")
    # What `changed` leaves as it is, because a type does not say what is valid.
    yield pytest.param("meshes", 5, lambda old: replace(old, normals=None), id="flat")
    yield pytest.param("meshes", 5, lambda old: replace(old, materials=old.materials * 0), id="other material")
    yield pytest.param("spheres", 1, lambda old: replace(old, material=0), id="other material of a sphere")
    yield pytest.param("materials", BLOCK, lambda old: replace(old, model=Model.TRACED), id="glass instead")
    yield pytest.param("materials", GLASS, lambda old: replace(old, model=Model.NONE), id="glass no more")
    yield pytest.param("materials", GLASS, lambda old: replace(old, priority=3), id="priority")
    yield pytest.param("lights", 0, lambda old: replace(old, kind=LightKind.DISK), id="another kind of light")
    yield pytest.param("probes", 1, lambda old: replace(old, mode="realtime"), id="sees what moves")
    yield pytest.param("probes", 1, lambda old: replace(old, resolution=16), id="finer probe")
    yield pytest.param("probes", 1, lambda old: replace(old, background=(0.1, 0.2, 0.3)), id="background")
    yield pytest.param("probes", 3, lambda old: replace(old, captured=("/wall3",)), id="sees something else")


@pytest.fixture(scope="module")
def warm() -> rc.Session:
    """Pictures share it in whatever order tests are run."""
    return rc.Session()


@pytest.mark.parametrize(("group", "row", "change"), list(variants()))
def test_every_change_of_a_record_is_noticed(
    group: str, row: int, change: Callable[[Any], Any], warm: rc.Session
) -> None:
    """The tables and the pictures of probes are what they are without a session, field by field."""
    before = busy()
    made_ready(before, warm)
    rows = list(getattr(before, group))
    rows[row] = change(rows[row])
    fields_changed: dict[str, Any] = {group: tuple(rows)}
    after = replace(before, **fields_changed)
    if any(one.planar and one.sees_glass for one in after.probes):  # there is no such probe
        return
    try:
        expected = ready_bits(made_ready(after))
    except (SceneError, np.linalg.LinAlgError):  # the change makes no scene
        return
    assert ready_bits(made_ready(after, warm)) == expected


MUTATIONS: dict[str, Callable[[Scene], NDArray[Any]]] = {
    "points": lambda s: s.meshes[5].points,
    "triangles": lambda s: s.meshes[5].triangles,
    "materials": lambda s: s.meshes[5].materials,
    "primvar": lambda s: s.meshes[5].primvars["place"],
    "texture": lambda s: s.textures[0].pixels,
    "sky": lambda s: s.environment.pixels if s.environment else np.zeros(0),
    "turn of the sky": lambda s: s.environment.dome_from_world if s.environment else np.zeros(0),
    "lamp": lambda s: s.lights[0].world_from_light,
    "place of a probe": lambda s: s.probes[1].influence.world_from_volume,
}


@pytest.mark.parametrize("array", list(MUTATIONS.values()), ids=list(MUTATIONS))
def test_a_mutated_thing_is_noticed(array: Callable[[Scene], NDArray[Any]]) -> None:
    """The same scene, the same records, the same array: other numbers in it."""
    what, session = busy(), rc.Session()
    first = ready_bits(made_ready(what, session))
    mine = array(what)
    kept = mine.copy()
    if mine.dtype.kind == "i":
        mine[0] = 0
    elif mine.shape[0] <= 4:  # a frame stays one: two of its axes change places
        mine[:, [0, 1]] = mine[:, [1, 0]]
    else:
        mine[[0, 1]] = mine[[1, 0]]
    second = ready_bits(made_ready(what, session))
    assert second == ready_bits(made_ready(what))
    assert second != first
    mine[...] = kept
    assert ready_bits(made_ready(what, session)) == first


def test_what_is_kept_is_not_the_callers_array() -> None:
    """Parts of a scene whose arrays are overwritten serve another scene that holds what was in them."""
    what, session = busy(), rc.Session()
    rc.render(what, SMALL, session=session)
    for array in MUTATIONS.values():
        array(what)[...] = 0
    assert bits(rc.render(busy(), SMALL, session=session)) == bits(rc.render(busy(), SMALL))


# --- made only where something changed ------------------------------------------------------------------------------


def thick(what: Scene, name: str) -> Scene:
    """Another thickness on the ball, as `bake thickness` puts it there."""
    glass = what.materials[GLASS]
    inputs = list(glass.inputs)
    inputs[Param.THICKNESS] = replace(inputs[Param.THICKNESS], primvar=name)
    materials = (*what.materials[:GLASS], replace(glass, inputs=tuple(inputs)), *what.materials[GLASS + 1 :])
    ball = replace(what.spheres[0], primvars={name: np.full((1, 1, 1), 0.9, np.float32)})
    return replace(what, materials=materials, spheres=(ball, *what.spheres[1:]))


CUBES = {"/probes/baked", "/probes/seeing", "/probes/some"}
LATER: dict[str, tuple[Callable[[Scene], Scene], set[str]]] = {
    "nothing": (lambda s: s, set()),
    "the same numbers in other arrays": (lambda _s: busy(), set()),
    "camera": (lambda s: replace(s, cameras=s.cameras[::-1]), {"/probes/window"}),
    # Opaque things show light that has come through glass.
    "glass": (lambda s: rc.override(s, {"/glass": {"ior": 1.7}}), {"/probes/window", *CUBES}),
    "what a primvar says of glass": (lambda s: thick(s, "thick"), {"geometry", "/probes/window", *CUBES}),
    "another primvar for glass": (lambda s: thick(s, "first"), {"geometry", "/probes/window", *CUBES}),
    "light": (
        lambda s: replace(s, lights=(replace(s.lights[0], radiance=(1.0, 1.0, 2.0)),)), {"/probes/window", *CUBES}
    ),
    "sky": (lambda s: replace(s, environment=None), {"environment", "/probes/window", *CUBES}),
    "one probe": (
        lambda s: replace(s, probes=(*s.probes[:2], replace(s.probes[2], clipping=(0.2, 9.0)), s.probes[3])),
        {"/probes/seeing"},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("later", "expected"), list(LATER.values()), ids=list(LATER))
def test_only_what_changed_is_made_anew(
    later: Callable[[Scene], Scene], expected: set[str], made: Counter[str]
) -> None:
    what, session = busy(), rc.Session()
    made_ready(what, session)
    assert set(made) == {"geometry", "textures", "environment", "/probes/window", *CUBES}
    made.clear()
    made_ready(later(what), session)
    assert set(made) == expected


def test_a_picture_without_probes_leaves_them_to_the_next(made: Counter[str]) -> None:
    """As the reference of `refract compare` does."""
    what, session = busy(), rc.Session()
    made_ready(what, session)
    plain = replace(what, probes=what.probes[:3])  # `captured` is marked in the hierarchy
    made_ready(plain, session)
    made.clear()
    made_ready(plain, session, replace(SMALL, tiers=("ray", "sky")))
    made_ready(plain, session)
    assert not made


def test_two_probes_of_one_path_stay_two() -> None:
    what = busy()
    what = replace(what, probes=tuple(replace(one, path="/probe") for one in what.probes))
    session = rc.Session()
    for _ in range(2):
        assert ready_bits(made_ready(what, session)) == ready_bits(made_ready(what))


# --- what is kept, and for how long -----------------------------------------------------------------------------------


def test_one_of_each_kind_is_kept() -> None:
    """A hierarchy is freed when another takes its place, unless a picture still needs it."""
    session, what = rc.Session(), busy()
    first = weakref.ref(made_ready(what, session).bvh)
    gc.collect()
    assert first() is not None
    other = replace(what, spheres=what.spheres[:1])
    held = made_ready(other, session)
    gc.collect()
    assert first() is None
    second = weakref.ref(held.bvh)
    session.clear()
    gc.collect()
    assert second() is held.bvh
    del held
    gc.collect()
    assert second() is None


def test_a_scene_that_cannot_be_made_ready_leaves_nothing_behind() -> None:
    session, what = rc.Session(), busy()
    bad = replace(what.meshes[5], normals=noise(3, 3, 3))
    for _ in range(2):
        with pytest.raises(SceneError, match="/block"):
            rc.render(replace(what, meshes=(*what.meshes[:5], bad)), SMALL, session=session)
    assert bits(rc.render(what, SMALL, session=session)) == bits(rc.render(what, SMALL))


def test_a_cancelled_picture_leaves_no_half_probe() -> None:
    session, what = rc.Session(), busy()
    for asked in range(1, 12):
        left = iter(range(asked))
        with pytest.raises(Cancelled):
            rc.render(what, SMALL, session=session, cancel=lambda left=left: next(left, None) is None)  # type: ignore[misc]
    assert bits(rc.render(what, SMALL, session=session)) == bits(rc.render(what, SMALL))


def test_threads_share_a_session() -> None:
    what = busy()
    scenes = [what, rc.override(what, {"/glass": {"ior": 1.7}}), replace(what, environment=None)]
    expected = [bits(rc.render(one, SMALL)) for one in scenes]
    session = rc.Session()
    with ThreadPoolExecutor(3) as threads:
        futures = [(k % 3, threads.submit(rc.render, scenes[k % 3], SMALL, session=session)) for k in range(9)]
        for k, future in futures:
            assert bits(future.result()) == expected[k]


def test_who_waits_for_another_threads_parts_may_give_up() -> None:
    session, begun, finish = rc.Session(), threading.Event(), threading.Event()

    def stay() -> None:
        with session.held(lambda: False):
            begun.set()
            finish.wait(60.0)

    thread = threading.Thread(target=stay)
    thread.start()
    begun.wait(60.0)
    try:
        asked = iter(range(3))
        with pytest.raises(Cancelled):
            rc.render(busy(), SMALL, session=session, cancel=lambda: next(asked, None) is None)
    finally:
        finish.set()
        thread.join()


# --- equal to the last bit --------------------------------------------------------------------------------------------


def test_equal_means_every_bit() -> None:
    nan = float("nan")
    assert same((nan, {"a": [1, "x", None]}), (float("nan"), {"a": [1, "x", None]}))
    assert not same(0.0, -0.0)
    assert not same(np.float32(0.0), np.float32(-0.0))
    assert not same(1, True)
    assert not same(1, 1.0)
    assert not same((1, 2), (1, 2, 3))
    assert not same({"a": 1}, {"b": 1})
    assert not same(np.zeros(3, np.float32), np.zeros(3, np.int32))
    assert not same(np.zeros((2, 3)), np.zeros((3, 2)))
    assert not same(np.zeros(2), np.array([0.0, -0.0]))
    assert same(np.array([nan]), np.array([nan]))
    assert same(np.zeros((0, 3)), np.zeros((0, 3)))
    assert same(np.arange(12).reshape(3, 4).T, np.arange(12).reshape(3, 4).T.copy())
    shared = np.array([[1]], object)
    assert not same(shared, shared.copy())  # what is in it may have changed


@pytest.mark.parametrize("size", [1, 7, 8, 9, 1000, (1 << 20) + 3])
def test_no_byte_is_passed_over(size: int) -> None:
    rng = np.random.default_rng(size)
    one = rng.integers(0, 256, size, np.uint8)
    assert same(one, one.copy())
    for place in {0, size - 1, size // 2, *rng.integers(0, size, 20).tolist()}:
        other = one.copy()
        other[place] ^= np.uint8(1 << rng.integers(0, 8))
        assert not same(one, other)


# --- who uses it ------------------------------------------------------------------------------------------------------


SILENT = Report(lambda _share, _stage: None, lambda _path, _text: None, lambda _path, _text: None, lambda _text: None)
QUICK = {"image_width": 16, "image_height": 12, "samples": 1, "jobs": 1}


def test_frames_are_the_files_that_single_frames_are(tmp_path: Path, made: Counter[str]) -> None:
    stage = str(SAMPLES / "marble.usda")
    order = Order(stage=stage, out=str(tmp_path / "all.##.exr"), frames="1:3", overrides=QUICK)
    render_files(order, SILENT, lambda: False)
    assert made["environment"] == made["textures"] == made["geometry"] == 1
    for frame in range(1, 4):
        render_files(replace(order, out=str(tmp_path / "one.##.exr"), frames=str(frame)), SILENT, lambda: False)
        alone, together = (tmp_path / f"{name}.{frame:02}.exr" for name in ("one", "all"))
        assert alone.read_bytes() == together.read_bytes()


def test_compare_makes_the_sky_once(tmp_path: Path, made: Counter[str]) -> None:
    """Picture, reference and every trial; and once a black one, to see whose pixels are whose."""
    order = CompareOrder(
        stage=str(SAMPLES / "marble.usda"), out=str(tmp_path / "out"), overrides=QUICK, reference_samples=1,
        suggest=True,
    )  # fmt: skip
    compare_stage(order, SILENT, lambda: False)
    assert made["environment"] == 2
    assert made["textures"] == 2


def test_the_busy_scene_is_busy() -> None:
    """Guards the tests above: glass is seen, and every probe is asked for."""
    what = busy()
    assert rc.render(what, SMALL).planes["weight.probe"].max() > 0.0
    assert (made_ready(what).probes.weight > 0.0).sum() == len(what.probes)
