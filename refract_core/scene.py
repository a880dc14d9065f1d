"""The plain records that pass through the doors: a stage as arrays, with no handle of any library in it.

Frame of everything here ("engine world"): right-handed, Y up, metres, moved so that the scene's centre is the
origin. `Scene.stage_from_engine` takes a point back to the stage's own world. Computed in float64, stored in float32.
Every record pickles.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from html import escape
from itertools import accumulate
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from .models import Model as Model

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U32 = NDArray[np.uint32]


class Channel(IntEnum):
    """Which part of a texture drives an input."""

    R = 0
    G = 1
    B = 2
    A = 3
    RGB = 4


class Wrap(IntEnum):
    BLACK = 0
    CLAMP = 1
    REPEAT = 2
    MIRROR = 3


class Param(IntEnum):
    """Material inputs that may be a constant, a texture or a primvar. The value is the column in `Material.inputs`."""

    DIFFUSE = 0  # color
    EMISSIVE = 1  # color, radiance [W sr^-1 m^-2, unitless scale]
    SPECULAR = 2  # color, F0 in the specular workflow
    METALLIC = 3
    ROUGHNESS = 4
    CLEARCOAT = 5
    CLEARCOAT_ROUGHNESS = 6
    OPACITY = 7
    IOR = 8
    NORMAL = 9  # vector3, tangent space, already scaled and biased to [-1, 1]
    OCCLUSION = 10
    THICKNESS = 11  # [m]
    TRANSMITTANCE = 12  # color left after `Material.absorption_distance`


@dataclass(frozen=True)
class Texture:
    """One decoded image. Row 0 is the top of the file (v = 1)."""

    name: str
    """Where it came from, for messages; also the key under which it was cached."""
    pixels: NDArray[np.uint8] | F32
    """shape (H, W, 4), RGBA; uint8 or float32. Missing channels are filled as USD says (a = 1)."""
    srgb: bool = False
    """True where uint8 RGB is sRGB-encoded; alpha never is. float32 is always linear."""


@dataclass(frozen=True)
class Source:
    """What drives one material input: a constant, a texture, or a primvar (first that is set: texture, primvar)."""

    value: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """The constant; the fallback where a texture or primvar is absent from the mesh. Scalars repeat in all four."""
    texture: int = -1
    """Index into `Scene.textures`, or -1."""
    channel: Channel = Channel.RGB
    wrap: tuple[Wrap, Wrap] = (Wrap.REPEAT, Wrap.REPEAT)
    scale: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    bias: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    uv_primvar: str = ""
    """Name of the float2 primvar that gives st (no `primvars:` prefix); '' means the constant `uv_value`."""
    uv_value: tuple[float, float] = (0.0, 0.0)
    """st where the mesh has no such primvar (the reader's fallback)."""
    uv_matrix: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Row-major 2x3: st' = M @ (s, t, 1), from UsdTransform2d."""
    primvar: str = ""
    """Name of the primvar that gives the value itself, or ''."""

    @property
    def driven(self) -> bool:
        """A texture or a primvar gives it, which `value` only stands in for."""
        return self.texture >= 0 or bool(self.primvar)


@dataclass(frozen=True)
class Material:
    """One row of the material table: a UsdPreviewSurface with the refraction attributes beside it."""

    name: str
    """Prim path of the material, or of the prim whose displayColor it stands for."""
    inputs: tuple[Source, ...]
    """One `Source` per `Param`, in that order."""
    model: Model = Model.NONE
    specular_workflow: bool = False
    opacity_presence: bool = False
    """opacityMode = presence: opacity is coverage, not glass."""
    opacity_threshold: float = 0.0
    """> 0 cuts out: opaque where opacity >= threshold, absent elsewhere."""
    absorption_distance: float = 1.0
    """[m]"""
    tints: bool = False
    """Its colour came without a distance, as the tint of a surface: readers put the way through its bodies there."""
    abbe: float = 0.0
    """Abbe number V_d; 0 means no dispersion."""
    priority: int = 0
    """Nested dielectrics: the higher one owns the overlap."""

    def __repr__(self) -> str:
        facts = [f"model={self.model.token}", *(f"{name}={text}" for name, text in _told_inputs(self))]
        return f"<Material {self.name}: {', '.join(facts)}>"

    def _repr_html_(self) -> str:
        """For a notebook."""
        return _table(self.name, {"model": self.model.token, **dict(_told_inputs(self))})

    @property
    def refractive(self) -> bool:
        return self.model is not Model.NONE

    @property
    def emits(self) -> bool:
        """Its emissive colour is not black, or a picture or primvar drives it."""
        source = self.inputs[Param.EMISSIVE]
        if source.driven:
            return max(source.scale[:3]) > 0.0 or max(source.bias[:3]) > 0.0
        return max(source.value[:3]) > 0.0

    @property
    def cutout(self) -> bool:
        """Some of the surface may be absent, so a hit must be looked at before it counts."""
        return self.opacity_threshold > 0.0 or self.opacity_presence


def prim_of(path: str) -> str:
    """The prim that a path belongs to: instances of a PointInstancer are drawn as `/Instancer/[7]/...`."""
    return path.partition("/[")[0]


@dataclass(frozen=True)
class Mesh:
    """Triangles of one prim, in engine world."""

    path: str
    points: F32
    """shape (V, 3) [m]"""
    triangles: U32
    """shape (T, 3), indices into `points`, counter-clockwise seen from outside (orientation and mirroring applied)."""
    materials: I32
    """shape (T,), index into `Scene.materials`, >= 0"""
    normals: F32 | None = None
    """shape (T, 3, 3): unit shading normal per triangle corner; None means flat."""
    primvars: dict[str, F32] = field(default_factory=dict)
    """name -> shape (T, 3, D) per triangle corner, or (1, 1, D) where constant; D = 1, 2, 3 or 4."""
    double_sided: bool = False
    closed: bool = False
    """Every edge is shared by exactly two triangles of opposite direction."""
    static: bool = True
    """Neither geometry nor transform varies in time and `primvars:refract:static` is not 0."""
    inside_out: bool = False
    """Closed glass whose faces look inwards as authored; here they are turned outwards already."""


@dataclass(frozen=True)
class Sphere:
    """A sphere gprim under a uniform scale: traced exactly, never tessellated."""

    path: str
    centre: tuple[float, float, float]
    """[m]"""
    radius: float
    """[m], > 0"""
    material: int
    primvars: dict[str, F32] = field(default_factory=dict)
    """name -> shape (1, 1, D): constants only."""
    static: bool = True


class Run(NamedTuple):
    """Paths that differ in numbers alone, as a point instancer gives them: `/P/[7]/Leaf`."""

    pieces: tuple[str, ...]
    """What stands before, between and behind the numbers"""
    numbers: I32
    """shape (N, len(pieces) - 1)"""

    def path(self, row: int) -> str:
        """One of them."""
        middle = (str(n) + piece for n, piece in zip(self.numbers[row].tolist(), self.pieces[1:], strict=True))
        return self.pieces[0] + "".join(middle)

    def has(self, path: str) -> bool:
        """One of them is it."""
        found = re.fullmatch("([0-9]{1,9})".join(map(re.escape, self.pieces)), path)
        return found is not None and bool((self.numbers == np.array(found.groups(), np.int64)).all(axis=1).any())


@dataclass(frozen=True)
class Paths(Sequence[str]):
    """Paths of many things, written when one is asked for: a million of them are a million numbers."""

    runs: tuple[str | Run, ...]
    """In order; a text is one path"""

    @cached_property
    def _ends(self) -> list[int]:
        return list(accumulate(1 if isinstance(run, str) else len(run.numbers) for run in self.runs))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | slice) -> str | list[str]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        index = index + len(self) if index < 0 else index
        if not 0 <= index < len(self):
            raise IndexError(index)
        at = bisect_right(self._ends, index)
        run = self.runs[at]
        return run if isinstance(run, str) else run.path(index - (self._ends[at - 1] if at else 0))

    def __iter__(self) -> Iterator[str]:
        for run in self.runs:
            if isinstance(run, str):
                yield run
            else:
                yield from (run.path(row) for row in range(len(run.numbers)))

    def __contains__(self, path: object) -> bool:
        return any(path == run if isinstance(run, str) else run.has(str(path)) for run in self.runs)

    def owners(self) -> Iterator[tuple[str, int]]:
        """The prims they belong to (`prim_of`), in order, and how many of them do."""
        for run in self.runs:
            if isinstance(run, str):
                yield prim_of(run), 1
            elif len(run.numbers):
                yield prim_of(run.path(0)), len(run.numbers)

    def take(self, chosen: NDArray[np.integer]) -> Paths:
        """Those at places, which ascend."""
        kept: list[str | Run] = []
        starts = np.searchsorted(chosen, [0, *self._ends])
        for k, run in enumerate(self.runs):
            mine = chosen[starts[k] : starts[k + 1]]
            if len(mine):
                first = self._ends[k - 1] if k else 0
                kept.append(run if isinstance(run, str) else Run(run.pieces, run.numbers[mine - first]))
        return Paths(tuple(kept))


@dataclass(frozen=True)
class Instances:
    """One mesh in many places, each of which is a thing of its own."""

    mesh: Mesh
    """In a frame of its own, best about its middle; what it says of itself holds for all, its path but for messages"""
    transforms: F32
    """shape (N, 3, 4): engine world from the mesh's frame [m]; none flattens. What one mirrors is not inside out"""
    paths: Paths
    """N of them"""
    primvars: dict[str, F32] = field(default_factory=dict)
    """name -> shape (N, D): one value for all of an instance; of other names than the mesh's own"""

    def __len__(self) -> int:
        return len(self.transforms)


@dataclass(frozen=True)
class Balls:
    """Many exact spheres of one material, each of which is a thing of its own: droplets, bubbles, points."""

    centres: F32
    """shape (N, 3) [m]"""
    radii: F32
    """shape (N,) [m], > 0"""
    material: int
    paths: Paths
    """N of them"""
    primvars: dict[str, F32] = field(default_factory=dict)
    """name -> shape (N, D), or (1, 1, D) where all have the same"""
    static: bool = True

    def __len__(self) -> int:
        return len(self.radii)


class LightKind(IntEnum):
    """The kinds of light: how each shines is its row in `world.lights`, how its size is read one in `usd.lights.read`.
    The value is what kernels see."""

    DISTANT = 0, "DistantLight"
    SPHERE = 1, "SphereLight"
    RECT = 2, "RectLight"
    DISK = 3, "DiskLight"
    CAMERA = 4, "", False
    """Stands in where a stage has no light: at the eye, without falloff. Nothing it lights is in a shadow."""
    CYLINDER = 5, "CylinderLight"
    """Its axis is the light's X. It shines outward, but not from its ends."""
    GLOW = 6, ""
    """Triangles of the stage that emit light; `world.emitters` makes these and the next, no reader does."""
    BALL = 7, ""
    """An exact sphere of the stage that emits light."""

    usd_type: str
    """Its prim type in UsdLux; '' for none."""
    casts_shadow: bool

    def __new__(cls, number: int, usd_type: str, casts_shadow: bool = True) -> LightKind:
        member = int.__new__(cls, number)
        member._value_ = number
        member.usd_type, member.casts_shadow = usd_type, casts_shadow
        return member


@dataclass(frozen=True)
class Shaping:
    """How a light's radiance hangs on the direction in which it leaves, and on the place on the light: UsdLux
    ShapingAPI, and the texture of a RectLight. The defaults leave it even."""

    focus: float = 0.0
    """Power of the cosine to the light's axis."""
    focus_tint: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What is left where that is 0."""
    cone: float = math.pi
    """Half angle beyond which nothing leaves [rad]."""
    softness: float = 0.0
    """Share of the cone over which it fades, 0 .. 1."""
    profile: F32 | None = None
    """shape (R, C): factor by direction. Rows from along the light's axis (-Z) to against it, evenly; columns around
    it, from +X by +Y, evenly, the last one the first again. One column: the same all around."""
    picture: F32 | None = None
    """shape (H, W, 3): factor by place on a rectangle, linear; row 0 at +Y, column 0 at +X, so that who stands before
    the light sees it upright."""


@dataclass(frozen=True)
class Shadow:
    """UsdLux ShadowAPI. The defaults are those of light itself."""

    color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Share of the light that arrives where it is hidden."""
    distance: float = math.inf
    """What is farther from a surface casts no shadow on it [m]."""
    falloff: float = 0.0
    """Shadows fade over this last part of it [m]."""
    gamma: float = 1.0
    """Power of the share that is left of `falloff`."""


@dataclass(frozen=True)
class Light:
    """A finite or distant light. Emits along -Z of its own frame, as UsdLux."""

    path: str
    kind: LightKind
    radiance: tuple[float, float, float]
    """color * intensity * 2^exposure * temperature, after `normalize`. For a zero-size (point or zero-angle) light,
    the intensity [radiance * m^2] or irradiance it is the limit of; for a cylinder without radius, radiance times its
    width [radiance * m]."""
    world_from_light: F64 = field(default_factory=lambda: np.eye(4))
    """shape (4, 4), column vectors, rotation and translation only [m]"""
    size: tuple[float, float] = (0.0, 0.0)
    """Rect: width, height [m]; Disk, Sphere: radius [m], 0 (world scale applied); Distant: angle [rad], 0;
    Cylinder: radius, length [m]."""
    diffuse: float = 1.0
    specular: float = 1.0
    shaping: Shaping = Shaping()
    """Not for distant lights."""
    casts_shadow: bool = True
    shadow: Shadow = Shadow()
    lit: tuple[str, ...] | None = None
    """Paths of the prims it lights (the `lightLink` collection); None means everything."""
    casters: tuple[str, ...] | None = None
    """Paths of the prims that cast its shadows (`shadowLink`); None means everything."""
    seen: bool = False
    """The camera sees it: where surfaces that glow give light, a body of its shape stands in its place."""


@dataclass(frozen=True)
class Environment:
    """All dome lights of the stage in one latlong map. `None` in the scene means black."""

    pixels: F32
    """shape (H, W, 3) radiance, row 0 = up (+Y of the dome), OpenEXR latlong: the image centre looks along +Z and
    u grows towards -X: u = 0.5 - atan2(x, z) / 2 pi, v = acos(y) / pi in the dome's frame."""
    dome_from_world: F64 = field(default_factory=lambda: np.eye(3))
    """shape (3, 3), rotates an engine-world direction into the dome's frame."""
    hidden: bool = False
    """It lights things, and shows in what they mirror. Past everything, and through glass, is `backdrop` instead."""
    backdrop: tuple[float, float, float] | None = None
    """Radiance, where hidden; None: nothing, the picture is open there."""


@dataclass(frozen=True)
class Camera:
    """Looks down -Z, +Y up, in its own frame."""

    path: str
    world_from_camera: F64
    """shape (4, 4), column vectors, rotation and translation only [m]"""
    window: tuple[float, float, float, float]
    """left, right, bottom, top of the picture: at distance 1 for perspective [unitless], in metres for orthographic.
    Aperture offsets are in it; its aspect is the camera's own, before conforming to the image."""
    orthographic: bool = False
    clipping: tuple[float, float] = (0.01, 1.0e6)
    """near, far along the camera axis [m]"""
    exposure_scale: float = 1.0
    """Linear factor on every colour (UsdGeomCamera.ComputeLinearExposureScale)."""
    lens_radius: float = 0.0
    """[m]; 0 is a pinhole, which has everything in focus. For perspective."""
    focus_distance: float = 1.0
    """[m] along the camera axis: what is there is sharp however wide the lens is."""
    shutter: tuple[float, float] = (0.0, 0.0)
    """open, close [time codes after that of the frame], where something moves in between; alike, it shows one
    instant."""
    framing: bool = False
    """Made to frame everything: a picture of another aspect is framed anew (`view.orbit`)."""


@dataclass(frozen=True)
class Volume:
    """A box or sphere with a frame: the influence or the proxy of a probe."""

    world_from_volume: F64
    """shape (4, 4), rotation and translation only [m] (scale is ignored, as in HDRP)"""
    sphere: bool
    extents: tuple[float, float, float]
    """box: half size [m]; sphere: (radius, radius, radius) [m]"""


CUBE_LEVELS = 7
"""Levels of a prefiltered cubemap: 0 is the capture, 1 .. 6 are blurred by GGX lobes (HDRP, IBLFilterGGX.cs)."""


@dataclass(frozen=True)
class Cubemap:
    """What is seen from one point in all directions, prefiltered or not.

    Faces +x -x +y -y +z -z of engine world (Y up, never turned with the probe), row 0 on top, each as OpenGL has it: at
    column i of n, with x = (i + 0.5) / n * 2 - 1, and y alike, +x looks along (1, -y, -x), -x along (-1, -y, x), +y
    along (x, 1, y), -y along (x, -1, -y), +z along (x, -y, 1), -z along (-x, -y, -1).
    """

    levels: tuple[F32, ...]
    """Level m: shape (6, n, n, 5) with n = max(1, resolution >> m): red, green, blue (premultiplied by coverage),
    coverage (0 where the sky is seen), distance [m] (0 where it is not known). CUBE_LEVELS of them, or just level 0."""

    @property
    def resolution(self) -> int:
        return int(self.levels[0].shape[1])


@dataclass(frozen=True)
class Bake:
    """What a baked texture was made from, as written down beside it."""

    digest: str
    """`probes.digest.probe_digest` of the scene at `time_code`"""
    engine: str
    """version of refract"""
    time_code: float


@dataclass(frozen=True)
class Probe:
    """A reflection probe: where it stands, what it sees, where it serves.

    A planar probe takes two pictures through its own xy plane as through a window: the mirrored eye's, for what it
    reflects, and the eye's own, for what lies behind it. The window is the influence volume's extent along x and y.
    """

    path: str
    mode: str
    """baked, realtime or custom"""
    capture_point: tuple[float, float, float]
    """[m]"""
    influence: Volume
    proxy: Volume | None
    """None: infinite (no local correction)."""
    resolution: int = 128
    clipping: tuple[float, float] = (0.1, 1000.0)
    """[m]"""
    cubemap: Cubemap | None = None
    """The baked or given picture; None means capture at render time."""
    bake: Bake | None = None
    """None where the picture does not say what it was made from."""
    planar: bool = False
    background: tuple[float, float, float] | None = None
    """Radiance where nothing is met; None lets the sky through."""
    distance_roughness: bool = False
    """Under `--screen proxy`: lower the roughness of what is near (HDRP, LightEvaluation.hlsl)."""
    marched: bool = False
    """The distances in its own picture say where a ray ends, and the proxy serves the screen alone. For cubes."""
    captured: tuple[str, ...] | None = None
    """Paths of the prims it sees (the `captured` collection); None means everything."""
    sees_glass: bool = False
    """Glass that it sees is drawn as in a picture. For realtime cubes; what `captured` leaves out is not there."""
    blend_distance: tuple[float, ...] = (0.0,) * 6
    """+x -x +y -y +z -z [m]"""
    blend_normal_distance: tuple[float, ...] = (0.0,) * 6
    face_fade: tuple[float, ...] = (1.0,) * 6
    importance: int = 1
    weight: float = 1.0
    multiplier: float = 1.0
    fade_distance: float = 10000.0
    """[m]"""


@dataclass(frozen=True)
class Notice:
    """Something the reader wants a person to know: what was ignored, replaced or guessed."""

    path: str
    """Prim path, file or flag it is about."""
    text: str
    """One sentence: what, why, what to do."""


@dataclass(frozen=True)
class Scene:
    """A stage at one time code."""

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    spheres: tuple[Sphere, ...] = ()
    textures: tuple[Texture, ...] = ()
    lights: tuple[Light, ...] = ()
    environment: Environment | None = None
    camera_light: bool = False
    """The stage has no light, no dome and nothing that glows: one shines from the camera, as in usdrecord."""
    cameras: tuple[Camera, ...] = ()
    """Every camera of the stage, by path; the reader puts the one it would choose first."""
    probes: tuple[Probe, ...] = ()
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-1, -1, -1), (1, 1, 1))
    """min, max of everything visible [m]"""
    stage_from_engine: F64 = field(default_factory=lambda: np.eye(4))
    """shape (4, 4), column vectors: metres in engine world to the stage's own world and units."""
    metres_per_unit: float = 0.01
    time_code: float = 0.0
    name: str = ""
    """The file it was read from."""
    notices: tuple[Notice, ...] = ()
    instances: tuple[Instances, ...] = ()
    """Things like the meshes; a reader makes them where there are many of one"""
    balls: tuple[Balls, ...] = ()
    """Things like the spheres"""

    def __repr__(self) -> str:
        facts = ", ".join(f"{what} {count}" for what, count in _told_scene(self).items())
        return f"<Scene {self.name.rpartition('/')[2] or 'without a name'} at {self.time_code:g}: {facts}>"

    def _repr_html_(self) -> str:
        """For a notebook."""
        glass = [material.name for material in self.materials if material.refractive]
        rows = {what: str(count) for what, count in _told_scene(self).items()}
        named = {"glass": _few(glass), "camera": self.cameras[0].path if self.cameras else ""}
        return _table(self.name, {**rows, **{what: text for what, text in named.items() if text}})


# --- in words -------------------------------------------------------------------------------------------------------

_FEW = 8


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - _FEW} more" if len(names) > _FEW else ""
    return ", ".join(names[:_FEW]) + more


def _told_scene(scene: Scene) -> dict[str, int]:
    """What there is in a scene, and how many of it; nothing of what there is none of."""
    every = (*scene.meshes, *(many.mesh for many in scene.instances))
    counts = {
        "meshes": len(scene.meshes), "spheres": len(scene.spheres) + sum(map(len, scene.balls)),
        "instances": sum(map(len, scene.instances)), "triangles": sum(len(mesh.triangles) for mesh in every),
        "materials": len(scene.materials), "of glass": sum(material.refractive for material in scene.materials),
        "textures": len(scene.textures), "lights": len(scene.lights), "domes": int(scene.environment is not None),
        "cameras": len(scene.cameras), "probes": len(scene.probes), "notices": len(scene.notices),
    }  # fmt: skip
    return {what: count for what, count in counts.items() if count}


def _told_inputs(material: Material) -> Iterator[tuple[str, str]]:
    """The inputs that say what a material looks like; those of glass where it is glass."""
    chosen = [Param.DIFFUSE, Param.ROUGHNESS, Param.OPACITY]
    if material.refractive:
        chosen = [Param.IOR, Param.THICKNESS, Param.TRANSMITTANCE, Param.ROUGHNESS]
    for param in chosen:
        source = material.inputs[param]
        color = param in (Param.DIFFUSE, Param.TRANSMITTANCE)
        text = "(" + ", ".join(f"{v:.4g}" for v in source.value[:3]) + ")" if color else f"{source.value[0]:.4g}"
        text = f"texture {source.texture}" if source.texture >= 0 else source.primvar or text
        yield param.name.lower(), text
    if material.refractive:
        yield "absorption_distance", f"{material.absorption_distance:.4g}"


def _table(title: str, rows: Mapping[str, str]) -> str:
    cells = "".join(f"<tr><th>{escape(what)}</th><td>{escape(text)}</td></tr>" for what, text in rows.items())
    return f"<table><caption>{escape(title)}</caption>{cells}</table>"
