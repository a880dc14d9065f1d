"""Embree 4 through its own C API: the device, one BVH, and the packet queries that kernels call.

The library is the `libembree4` inside the `embreex` wheel; embreex itself is never imported (its wrapper has no masks,
no packets and one thread per call). Compiled kernels call `rtcIntersect8` and `rtcOccluded8` directly, and by name, so
that they can be kept on disk: what the addresses are is said when the library is opened.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import EmbreeError, SceneError
from ..kernels.arrays import F32_2D, I32_1D, I32_2D, I64_1D
from ..kernels.compile import External, flag, inlined, word
from ..kernels.lanes import LANES, Flags, Scalars, Words
from ..kernels.vec import Vec

# Ray masks: what a ray may see. A geometry carries one of the first five, and one of the rest per captured set.
SOLID_STATIC = word(1)
SOLID_MOVING = word(2)
CUTOUT_STATIC = word(4)
CUTOUT_MOVING = word(8)
REFRACTIVE = word(16)
FIRST_CAPTURED_BIT = 5
CASTER_SHIFTS = (27, 23, 19, 15)
"""What casts the shadows of lights that not everything casts carries the first four bits again, so much higher: one
place for each set of casters, taken from the top. No more captured sets than fit below."""
SOLID = SOLID_STATIC | SOLID_MOVING
CUTOUT = CUTOUT_STATIC | CUTOUT_MOVING
OPAQUE = SOLID | CUTOUT
OPAQUE_STATIC = SOLID_STATIC | CUTOUT_STATIC
EVERYTHING = word(-1)

# Whether the rays of a packet stay together: Embree then culls with their common frustum.
COHERENT = flag(True)
SCATTERED = flag(False)

_INVALID = -1  # RTC_INVALID_GEOMETRY_ID as int32
_COHERENT_FLAG = 1 << 16  # RTC_RAY_QUERY_FLAG_COHERENT
_TRIANGLE, _SPHERE_POINT, _INSTANCE_ARRAY = 0, 50, 122  # RTCGeometryType
_INDEX, _VERTEX, _TRANSFORM = 0, 1, 23  # RTCBufferType
_UINT3, _FLOAT3, _FLOAT4, _FLOAT3X4 = 0x5003, 0x9003, 0x9004, 0x9134  # RTCFormat; the last row by row
_ROBUST = 1 << 2  # RTC_SCENE_FLAG_ROBUST
_SOME = 1 << 16  # transforms that are looked at together

# Rows of RTCRayHit8 (each row is one 32-bit word for eight lanes).
ORG_X, ORG_Y, ORG_Z, T_NEAR, DIR_X, DIR_Y, DIR_Z, TIME, T_FAR, MASK, RAY_ID, FLAGS = range(12)
NG_X, NG_Y, NG_Z, HIT_U, HIT_V, PRIM, GEOM, INST, INST_PRIM = range(12, 21)
_WORDS = 21

_rtc_intersect8 = External("rtcIntersect8", 4)
_rtc_occluded8 = External("rtcOccluded8", 4)


@cache
def library() -> ctypes.CDLL:
    """Open the bundled Embree once and tell kernels where its query functions are.

    Raises:
        EmbreeError: the embreex wheel, or the library in it, is not there.
    """
    try:
        files = metadata.files("embreex") or []
    except metadata.PackageNotFoundError as missing:
        raise EmbreeError("embreex, which brings Embree, is not installed; pip install embreex") from missing
    # The wheel repairers of the three platforms name and place the file differently.
    found = [f for f in files if "embree4" in f.name and (".so" in f.name or f.name.endswith((".dylib", ".dll")))]
    if not found:
        raise EmbreeError("embreex is installed but holds no embree4 library; reinstall a binary wheel of embreex")
    lib = ctypes.CDLL(str(found[0].locate()))
    handle, size, flag = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "rtcNewDevice": (handle, [ctypes.c_char_p]),
        "rtcReleaseDevice": (None, [handle]),
        "rtcGetDeviceError": (ctypes.c_int, [handle]),
        "rtcNewScene": (handle, [handle]),
        "rtcSetSceneFlags": (None, [handle, flag]),
        "rtcCommitScene": (None, [handle]),
        "rtcReleaseScene": (None, [handle]),
        "rtcNewGeometry": (handle, [handle, ctypes.c_int]),
        "rtcSetSharedGeometryBuffer": (None, [handle, ctypes.c_int, flag, ctypes.c_int, handle, size, size, size]),
        "rtcSetGeometryMask": (None, [handle, flag]),
        "rtcSetGeometryInstancedScene": (None, [handle, handle]),
        "rtcCommitGeometry": (None, [handle]),
        "rtcAttachGeometryByID": (None, [handle, handle, flag]),
        "rtcReleaseGeometry": (None, [handle]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    for query in (_rtc_intersect8, _rtc_occluded8):
        address = ctypes.cast(getattr(lib, query.name), ctypes.c_void_p).value
        assert address is not None
        query.bind(address)
    return lib


class Part(NamedTuple):
    """One Embree geometry: a run of triangles, in one place or in many, or exact spheres."""

    mask: int
    triangles: NDArray[np.uint32] | None
    """shape (T, 3), indices into the points given to `build`; None for a sphere. Parts with transforms that have the
    same array share its hierarchy"""
    sphere: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """centre, radius [m]"""
    transforms: NDArray[np.float32] | None = None
    """shape (N, 3, 4): the places of the triangles, whose points are in a frame of their own; None: where they are"""
    balls: NDArray[np.float32] | None = None
    """shape (N, 4): centres, radii [m], in place of the one sphere"""


class Bvh:
    """A committed scene. Geometry IDs are the positions in `parts`. Handles are freed with the object."""

    def __init__(self, points: NDArray[np.float32], parts: Iterable[Part]) -> None:
        """Build from shared arrays, which are kept alive as long as the object.

        Args:
            points: shape (V, 3) float32, metres, finite.
            parts: what to attach, in order.

        Raises:
            SceneError: wrong shape, index out of range, NaN or infinite point, radius not above zero.
            EmbreeError: Embree refused.
        """
        lib = library()
        parts = list(parts)
        check_parts(points, parts)
        # Embree may read 16 bytes at the last vertex.
        self._points = np.zeros((len(points) + 2, 3), np.float32)
        self._points[: len(points)] = points
        self._buffers: list[NDArray[Any]] = []
        shared: dict[int, int] = {}
        device = lib.rtcNewDevice(None)
        if not device:
            raise EmbreeError(f"Embree cannot start on this machine (error {lib.rtcGetDeviceError(None)})")
        scene = lib.rtcNewScene(device)
        self._free = weakref.finalize(self, _release, lib, scene, device)
        lib.rtcSetSceneFlags(scene, _ROBUST)
        for identifier, part in enumerate(parts):
            if part.transforms is None:
                self._attach(lib, scene, identifier, self._geometry(lib, device, part), part.mask)
                continue
            if id(part.triangles) not in shared:
                shared[id(part.triangles)] = self._apart(lib, device, part)
            places = self._places(lib, device, part.transforms, shared[id(part.triangles)])
            self._attach(lib, scene, identifier, places, part.mask)
        for inner in shared.values():  # what stands in it keeps it
            lib.rtcReleaseScene(inner)
        lib.rtcCommitScene(scene)
        if error := lib.rtcGetDeviceError(device):
            raise EmbreeError(f"Embree failed to build the scene (error {error}; 4 means out of memory)")
        self.handle = int(scene)
        """Address of the RTCScene, for kernels."""

    @property
    def points(self) -> NDArray[np.float32]:
        """As they were given, shape (V, 3) [m]: the copy that Embree reads."""
        return self._points[:-2]

    def _kept(self, array: NDArray[Any]) -> int:
        """Address of what Embree reads as long as this lives."""
        self._buffers.append(array)
        return int(array.ctypes.data)

    def _geometry(self, lib: ctypes.CDLL, device: int, part: Part) -> int:
        """Triangles where their points are, or a sphere."""
        if part.triangles is not None:
            geometry = lib.rtcNewGeometry(device, _TRIANGLE)
            pool, count = self._points, len(self._points) - 2
            array = np.ascontiguousarray(part.triangles, np.uint32)
            lib.rtcSetSharedGeometryBuffer(geometry, _VERTEX, 0, _FLOAT3, pool.ctypes.data, 0, 12, count)
            lib.rtcSetSharedGeometryBuffer(geometry, _INDEX, 0, _UINT3, self._kept(array), 0, 12, len(array))
        else:
            geometry = lib.rtcNewGeometry(device, _SPHERE_POINT)
            some = part.balls if part.balls is not None else np.array([part.sphere])
            balls = np.ascontiguousarray(some, np.float32)
            lib.rtcSetSharedGeometryBuffer(geometry, _VERTEX, 0, _FLOAT4, self._kept(balls), 0, 16, len(balls))
        return int(geometry)

    def _apart(self, lib: ctypes.CDLL, device: int, part: Part) -> int:
        """A scene of triangles alone. It hides nothing from any ray: the mask is for each of its places to have."""
        inner = lib.rtcNewScene(device)
        lib.rtcSetSceneFlags(inner, _ROBUST)
        self._attach(lib, inner, 0, self._geometry(lib, device, part), int(EVERYTHING))
        lib.rtcCommitScene(inner)
        return int(inner)

    def _places(self, lib: ctypes.CDLL, device: int, transforms: NDArray[np.float32], inner: int) -> int:
        geometry = lib.rtcNewGeometry(device, _INSTANCE_ARRAY)
        lib.rtcSetGeometryInstancedScene(geometry, inner)
        array = np.ascontiguousarray(transforms, np.float32)
        lib.rtcSetSharedGeometryBuffer(geometry, _TRANSFORM, 0, _FLOAT3X4, self._kept(array), 0, 48, len(array))
        return int(geometry)

    def _attach(self, lib: ctypes.CDLL, scene: int, identifier: int, geometry: int, mask: int) -> None:
        """Gives a geometry away to a scene."""
        lib.rtcSetGeometryMask(geometry, int(mask) & 0xFFFFFFFF)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometryByID(scene, geometry, identifier)
        lib.rtcReleaseGeometry(geometry)

    def close(self) -> None:
        """Free the handles now; queries after this are undefined."""
        self._free()


def _release(lib: ctypes.CDLL, scene: int, device: int) -> None:
    lib.rtcReleaseScene(scene)
    lib.rtcReleaseDevice(device)


def check_parts(points: NDArray[np.float32], parts: list[Part]) -> None:
    """Refuse what Embree would accept in silence. Raises SceneError."""
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype != np.float32:
        raise SceneError(f"points must be float32 of shape (V, 3), not {points.dtype} {points.shape}")
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise SceneError(f"point {bad} is NaN or infinite: {points[bad].tolist()}")
    for i, part in enumerate(parts):
        t = part.triangles
        if t is None:
            if part.balls is not None:
                wrong = np.flatnonzero(~np.isfinite(part.balls).all(axis=1) | (part.balls[:, 3] <= 0))
                if len(wrong):
                    text = f"sphere {part.balls[wrong[0]].tolist()} must be finite with a radius above 0"
                    raise SceneError(f"part {i}, number {wrong[0]}: {text}")
            elif not np.isfinite(part.sphere).all() or part.sphere[3] <= 0:
                raise SceneError(f"part {i}: sphere {part.sphere} must be finite with a radius above 0")
        elif t.ndim != 2 or t.shape[1] != 3 or t.dtype.kind not in "ui":
            raise SceneError(f"part {i}: triangles must be integers of shape (T, 3), not {t.dtype} {t.shape}")
        elif t.size and (int(t.max()) >= len(points) or int(t.min()) < 0):
            raise SceneError(f"part {i}: a triangle index is outside 0 .. {len(points) - 1}")
        if part.transforms is not None:
            try:
                check_transforms(part.transforms)
            except SceneError as error:
                raise SceneError(f"part {i}: {error}") from None


def check_transforms(transforms: NDArray[np.float32]) -> None:
    """Refuse places that are none, or leave nothing of a body. Raises SceneError."""
    if transforms.ndim != 3 or transforms.shape[1:] != (3, 4) or transforms.dtype != np.float32:
        raise SceneError(f"transforms must be float32 of shape (N, 3, 4), not {transforms.dtype} {transforms.shape}")
    for start in range(0, len(transforms), _SOME):
        some = transforms[start : start + _SOME]
        linear = some[:, :, :3].astype(np.float64)
        volume = (linear[:, 0] * np.cross(linear[:, 1], linear[:, 2])).sum(axis=1)
        bad = np.flatnonzero(~np.isfinite(some).all(axis=(1, 2)) | ~(np.abs(volume) > 0.0))
        if len(bad):
            raise SceneError(f"transform {start + bad[0]} is not finite, or flattens: {some[bad[0]].tolist()}")


class Packet(NamedTuple):
    """Eight rays and their hits in Embree's own layout; one per thread."""

    rays: F32_2D
    """shape (21, 8) float32, 64-byte aligned: rows ORG_X .. INST_PRIM"""
    words: I32_2D
    """the same memory as int32: MASK, PRIM, GEOM, ..."""
    valid: I32_1D
    """shape (8,) int32: -1 traces the lane, 0 leaves it alone"""
    arguments: I32_1D
    """shape (8,) int32: RTCIntersectArguments"""
    tally: I64_1D
    """shape (1,) int64: rays traced so far"""
    asked: Flags
    """`valid` as the caller of `tracing.intersect_world` set it, while it looks behind cut-outs"""
    chance: Flags
    """1 where the ray of a lane met a surface that is there by chance, or not (`tracing.intersect_world`)"""
    toss: Scalars
    """and the number in [0, 1) that decides how far it comes"""
    through: Scalars
    """share of the light that the layers on it have left so far"""
    x: Words
    """of the pixel a ray belongs to; with the next two what `tracing` tosses for surfaces that are there by chance"""
    y: Words
    sample: Words
    """of that pixel; -1 where the ray is on its own"""
    shadowed: Flags
    """`valid` as the caller of `tracing.visible` set it, while it looks behind cut-outs and through glass"""
    ends: Scalars
    """T_FAR of the segments that `tracing.visible` was asked about"""
    begun: Scalars
    """where along each the stretch begins that no glass has absorbed along yet"""

    @staticmethod
    def fresh() -> Packet:
        """A packet on fresh memory, for use by one thread at a time."""
        memory = np.zeros((_WORDS + 3) * LANES + 16, np.float32)
        skip = (-memory.ctypes.data % 64) // 4
        flat = memory[skip : skip + (_WORDS + 3) * LANES]
        ints = flat.view(np.int32)
        arguments = ints[(_WORDS + 1) * LANES :]  # 40 bytes, so two rows
        arguments[1] = -1  # RTC_FEATURE_FLAG_ALL; context, filter and callback stay null
        return Packet(
            rays=flat[: _WORDS * LANES].reshape(_WORDS, LANES),
            words=ints[: _WORDS * LANES].reshape(_WORDS, LANES),
            valid=ints[_WORDS * LANES : (_WORDS + 1) * LANES],
            arguments=arguments,
            tally=np.zeros(1, np.int64),
            asked=np.zeros(LANES, np.int32),
            chance=np.zeros(LANES, np.int32),
            toss=np.zeros(LANES),
            through=np.ones(LANES),
            x=np.zeros(LANES, np.int32),
            y=np.zeros(LANES, np.int32),
            sample=np.full(LANES, -1, np.int32),
            shadowed=np.zeros(LANES, np.int32),
            ends=np.zeros(LANES),
            begun=np.zeros(LANES),
        )


@inlined
def clear(packet: Packet) -> None:
    """No lane active."""
    for lane in range(LANES):
        packet.valid[lane] = 0


@inlined
def set_ray(packet: Packet, lane: int, origin: Vec, direction: Vec, t_near: float, t_far: float, mask: int) -> None:
    """Put a ray into a lane and activate it. `direction` need not be unit; distances are in its length."""
    rays, words = packet.rays, packet.words
    rays[ORG_X, lane] = origin[0]
    rays[ORG_Y, lane] = origin[1]
    rays[ORG_Z, lane] = origin[2]
    rays[T_NEAR, lane] = t_near
    rays[DIR_X, lane] = direction[0]
    rays[DIR_Y, lane] = direction[1]
    rays[DIR_Z, lane] = direction[2]
    rays[T_FAR, lane] = t_far
    words[MASK, lane] = mask
    words[GEOM, lane] = _INVALID
    packet.sample[lane] = -1
    packet.valid[lane] = -1


@inlined
def restart(packet: Packet, lane: int, t_near: float, t_far: float) -> None:
    """Send the ray of a lane on its way again, over another stretch of it."""
    packet.rays[T_NEAR, lane] = t_near
    packet.rays[T_FAR, lane] = t_far
    packet.words[GEOM, lane] = _INVALID
    packet.valid[lane] = -1


@inlined
def ray_origin(packet: Packet, lane: int) -> Vec:
    """Where the ray of a lane starts, as Embree has it [m]."""
    rays = packet.rays
    return (np.float64(rays[ORG_X, lane]), np.float64(rays[ORG_Y, lane]), np.float64(rays[ORG_Z, lane]))


@inlined
def ray_direction(packet: Packet, lane: int) -> Vec:
    """Where the ray of a lane goes, as Embree has it; of the length it was given."""
    rays = packet.rays
    return (np.float64(rays[DIR_X, lane]), np.float64(rays[DIR_Y, lane]), np.float64(rays[DIR_Z, lane]))


@inlined
def has_hit(packet: Packet, lane: int) -> bool:
    """The ray of a lane was traced by `intersect`, and met something."""
    return packet.valid[lane] != 0 and packet.words[GEOM, lane] >= 0


@inlined
def hit_distance(packet: Packet, lane: int) -> float:
    """Distance to the hit of a lane, in lengths of its direction; T_FAR as it was given where there is none."""
    return np.float64(packet.rays[T_FAR, lane])


@inlined
def is_blocked(packet: Packet, lane: int) -> bool:
    """The ray of a lane was traced by `occluded`, and something is in its way."""
    return packet.valid[lane] != 0 and packet.rays[T_FAR, lane] < 0.0


@inlined
def _count_active(packet: Packet) -> int:
    """How many lanes are going to be traced; the tally grows by as many."""
    n = 0
    for lane in range(LANES):
        n -= packet.valid[lane]
    packet.tally[0] += n
    return n


@inlined
def intersect(packet: Packet, scene: int, coherent: bool) -> None:
    """Nearest hit of every active lane; GEOM is -1 where there is none. T_FAR becomes the hit distance."""
    if _count_active(packet) == 0:
        return
    packet.arguments[0] = _COHERENT_FLAG if coherent else 0
    _rtc_intersect8(packet.valid.ctypes.data, scene, packet.rays.ctypes.data, packet.arguments.ctypes.data)


@inlined
def occluded(packet: Packet, scene: int, coherent: bool) -> None:
    """Any hit of every active lane: T_FAR becomes -inf where something is in the way."""
    if _count_active(packet) == 0:
        return
    packet.arguments[0] = _COHERENT_FLAG if coherent else 0
    _rtc_occluded8(packet.valid.ctypes.data, scene, packet.rays.ctypes.data, packet.arguments.ctypes.data)
