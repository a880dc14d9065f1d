"""Whether the same roughness looks the same on every tier: the blur of an edge seen through a rough slab of glass.

    python -m benchmarks.roughness [--roughness 0.1,0.3,0.5,0.7] [--size 640] [--rays 400000]

The camera is orthographic and looks straight at the slab, so that the profile of the edge in the picture is the
distribution of the rays behind the slab, along one axis. Blur is half of the way from 25 % to 75 % of that profile, in
millimetres on a wall 1 m behind the slab; for the sky, which has no distance, the tangent of the angle times 1 m. The
reference is a Monte Carlo of two rough faces (`benchmarks.lobe`). A number in brackets is blur over reference.

HDRP columns are `--screen proxy`: its own maps from roughness to level, which know neither ior nor distance; the level
of the screen depends on the size of the picture, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import refract_core as rc
from refract_core.optics.interface import transmitted_roughness
from refract_core.scene import Camera, Environment, Material, Mesh, Model, Probe, Scene, Volume

from .lobe import edge_half_width, median_slope, slab, straight, through_interface
from .room import surface

F64 = NDArray[np.float64]

IOR = 1.5
THICKNESS = 0.01
"""Of the slab [m]"""
DISTANCE = 1.0
"""From the slab to the wall [m]"""
ROUGHNESS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
_WIDE = 200.0  # half size of wall and proxy [m]: the lobes have long tails
_SKY = 2048  # texels around the sky
# Where the edge falls between texels of coarse levels is chance, so it is put in several places.
_PROBE_SHIFTS = (0.03, 0.1, 0.17)  # of the capture along x [m]
_SKY_SHIFTS = (0, 37, 411)  # of the edge along the map [texels]


class Options(NamedTuple):
    """What the command line says."""

    size: int = 640
    """width of the picture that the screen tier reads [pixels]"""
    rays: int = 400_000
    """of the Monte Carlo"""
    resolution: int = 512
    """of a face of the probe [pixels]"""
    samples: int = 256
    """of the ray tier"""


# ------------------------------------------------------------------------------------------------ the scene


def edge_scene(roughness: float, half_window: float, resolution: int = 0, shift: float = 0.0) -> Scene:
    """A slab, and behind it a wall that is bright where x > 0 and black elsewhere.

    Args:
        half_window: half width of what the camera sees [m].
        resolution: of a face of a probe at the slab, whose proxy ends at the wall; 0 for none.
        shift: of the probe's capture along x [m].
    """
    far = -THICKNESS - DISTANCE
    meshes = [_sheet("/glass", (-_WIDE, _WIDE), 0.0, 0), _sheet("/bright", (0.0, _WIDE), far, 1),
              _sheet("/dark", (-_WIDE, 0.0), far, 2)]  # fmt: skip
    materials = (_rough_glass(roughness), surface("/bright", EMISSIVE=1.0), surface("/dark"))
    probes = (_probe(resolution, shift),) if resolution else ()
    return _scene(meshes, materials, half_window, probes=probes)


def sky_scene(roughness: float, angle: float, shift: int = 0) -> Scene:
    """A slab before a sky whose right half is bright.

    Args:
        angle: from the camera's axis to the edge, to the left [rad].
        shift: of the edge in the map [texels], against which the sky is turned.
    """
    sky = np.zeros((_SKY // 2, _SKY, 3), np.float32)
    sky[:, : _SKY // 2] = 1.0  # x > 0; the edge is seen along -z
    sky = np.roll(sky, shift, axis=1)
    turn = angle + 2.0 * np.pi * shift / _SKY
    c, s = np.cos(turn), np.sin(turn)
    environment = Environment(sky, np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]))
    meshes = [_sheet("/glass", (-_WIDE, _WIDE), 0.0, 0)]
    return _scene(meshes, (_rough_glass(roughness),), 0.1, environment=environment)


def _scene(meshes: list[Mesh], materials: tuple[Material, ...], half_window: float, **fields: Any) -> Scene:
    world_from_camera = np.eye(4)
    world_from_camera[2, 3] = 1.0
    flat = half_window / 1000.0  # the picture's aspect makes it higher, never wider
    window = (-half_window, half_window, -flat, flat)
    camera = Camera("/camera", world_from_camera, window, orthographic=True)
    bounds = ((-_WIDE, -_WIDE, -DISTANCE - THICKNESS), (_WIDE, _WIDE, 1.0))
    return Scene(tuple(meshes), materials, cameras=(camera,), bounds=bounds, metres_per_unit=1.0, name="edge", **fields)


def _rough_glass(roughness: float) -> Material:
    return surface(
        "/glass", Model.BOX, OPACITY=0.0, ROUGHNESS=roughness, IOR=IOR, THICKNESS=THICKNESS, TRANSMITTANCE=1.0
    )


def _sheet(path: str, across: tuple[float, float], z: float, index: int) -> Mesh:
    """A quad that faces the camera."""
    (a, b), h = across, _WIDE
    points = np.array([[a, -h, z], [b, -h, z], [b, h, z], [a, h, z]], np.float32)
    return Mesh(path, points, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), np.full(2, index, np.int32))


def _probe(resolution: int, shift: float) -> Probe:
    here = np.eye(4)
    here[2, 3] = -THICKNESS
    volume = Volume(here, False, (_WIDE, _WIDE, DISTANCE))
    at = (shift, 0.0, -THICKNESS)
    return Probe("/probe", "realtime", at, volume, volume, resolution, clipping=(0.001, 1000.0))


# ------------------------------------------------------------------------------------------------ measuring


def profile(scene: Scene, settings: rc.RenderSettings) -> tuple[F64, F64]:
    """Places along the wall [m] and what is seen there, averaged over the middle rows."""
    frame = rc.render(scene, settings)
    left, right = scene.cameras[0].window[:2]
    x = left + (right - left) * (np.arange(frame.width) + 0.5) / frame.width
    rows = slice(frame.height // 4, max(frame.height // 4 + 1, 3 * frame.height // 4))
    return x, frame.planes["refraction"][rows, :, 0].mean(0, dtype=np.float64)


def half_width(x: F64, seen: F64) -> float:
    """Half of the way from 25 % to 75 % of the profile of an edge at 0.

    Bright and dark sides are made one, so only the share of light that belongs to x counts: a picture that fades
    evenly to both sides measures the same. Nan where the profile never gets to 75 %.

    Args:
        x: shape (N,), ascending, symmetric about 0.
        seen: shape (N,), bright where x > 0.
    """
    n = len(x) // 2
    right, left = seen[len(x) - n :], seen[:n][::-1]
    total = right + left
    share = np.where(total > 0.0, right / np.where(total > 0.0, total, 1.0), 0.5)
    places = np.concatenate([[0.0], x[len(x) - n :]])
    share = np.concatenate([[0.5], share])
    reached = np.flatnonzero(share >= 0.75)
    if len(reached) == 0:
        return float("nan")
    near = (share > 0.62) & (share < 0.86) & (places < 3.0 * places[reached[0]])
    if near.sum() < 8:  # sharp: nothing to smooth
        k = int(reached[0])
        return float(np.interp(0.75, share[k - 1 : k + 1], places[k - 1 : k + 1]))
    curve = np.polynomial.Polynomial.fit(places[near], share[near], 2)
    fine = np.linspace(places[near][0], places[near][-1], 1001)
    return float(np.interp(0.75, np.maximum.accumulate(curve(fine)), fine))


def by_screen(roughness: float, reference: float, options: Options, method: str = "traced") -> float:
    """Blur of the screen tier. The picture shows 2 m of wall, whatever the roughness: levels are what is tested."""
    settings = rc.RenderSettings(
        image_width=options.size, image_height=options.size // 10, samples=1, tiers=("screen",), screen=method
    )
    x, seen = profile(edge_scene(roughness, DISTANCE, 8 if method == "proxy" else 0), settings)
    inner = np.abs(x) < 0.85 * DISTANCE  # the rest fades
    return half_width(x[inner], seen[inner])


def by_ray(roughness: float, reference: float, options: Options) -> float:
    """Blur of the ray tier."""
    settings = rc.RenderSettings(image_width=128, image_height=16, samples=options.samples, tiers=("ray",))
    return half_width(*profile(edge_scene(roughness, 8.0 * reference), settings))


def by_probe(roughness: float, reference: float, options: Options, method: str = "traced") -> float:
    """Blur of the probe tier. The window is wide enough for a blur several times too large."""
    settings = rc.RenderSettings(image_width=1024, image_height=16, samples=1, tiers=("probe",), screen=method)
    scenes = [edge_scene(roughness, 16.0 * reference, options.resolution, shift) for shift in _PROBE_SHIFTS]
    return float(np.mean([half_width(*profile(scene, settings)) for scene in scenes]))


def by_sky(roughness: float, reference: float, options: Options) -> float:
    """Blur of the sky tier, by turning the sky until three quarters of the light are seen."""
    settings = rc.RenderSettings(image_width=8, image_height=8, samples=1, tiers=("sky",))

    def light(angle: float, shift: int) -> float:
        return float(rc.render(sky_scene(roughness, angle, shift), settings).planes["refraction"][4, 4, 0])

    def angle_of(shift: int) -> float:
        low, high = 0.0, min(1.5, 8.0 * reference / DISTANCE)
        for _ in range(10):
            middle = 0.5 * (low + high)
            right, left = light(middle, shift), light(-middle, shift)
            low, high = (middle, high) if right < 3.0 * left else (low, middle)
        return 0.5 * (low + high)

    return float(np.tan(np.mean([angle_of(shift) for shift in _SKY_SHIFTS]))) * DISTANCE


Measure = Callable[[float, float, Options], float]
COLUMNS: dict[str, Measure] = {
    "screen": by_screen,
    "ray": by_ray,
    "probe": by_probe,
    "sky": by_sky,
    "HDRP screen": lambda r, reference, options: by_screen(r, reference, options, "proxy"),
    "HDRP probe": lambda r, reference, options: by_probe(r, reference, options, "proxy"),
}


def row_of(roughness: float, options: Options, columns: dict[str, Measure]) -> tuple[float, list[float]]:
    """The reference and the blur of every column [m]."""
    reference = edge_half_width(roughness, IOR, THICKNESS, DISTANCE, options.rays)
    return reference, [measure(roughness, reference, options) for measure in columns.values()]


def width_factors(roughness: float, ior: float, rays: int) -> tuple[float, float]:
    """The factor f of alpha_t = f alpha of the reflected lobe that is as wide: behind one face, behind two.

    A reflected lobe of alpha_t has its median at the slope 2 alpha_t.
    """
    alpha = roughness * roughness
    u = np.random.default_rng(2).random((2, rays))
    one = through_interface(straight(rays), alpha, 1.0 / ior, u)
    return median_slope(one) / (2.0 * alpha), median_slope(slab(roughness, ior, rays)[1]) / (2.0 * alpha)


def fitted_factor(roughness: float, ior: float, two_interfaces: bool) -> float:
    """The same factor as the engine has it."""
    return (transmitted_roughness(roughness, ior, two_interfaces) / roughness) ** 2


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--roughness", default=",".join(map(str, ROUGHNESS)))
    parser.add_argument("--size", type=int, default=640, help="width of the picture the screen tier reads [pixels]")
    parser.add_argument("--rays", type=int, default=400_000, help="of the Monte Carlo")
    parser.add_argument("--resolution", type=int, default=512, help="of a face of the probe [pixels]")
    parser.add_argument("--columns", default=",".join(COLUMNS))
    arguments = parser.parse_args()
    names = arguments.columns.split(",")
    if unknown := [name for name in names if name not in COLUMNS]:
        parser.error(f"--columns has {', '.join(unknown)}; choose from {', '.join(COLUMNS)}")
    columns = {name: COLUMNS[name] for name in names}
    options = Options(arguments.size, arguments.rays, arguments.resolution)
    roughness = [float(value) for value in arguments.roughness.split(",")]
    print(f"blur of an edge {DISTANCE:g} m behind a rough slab, ior {IOR:g} [mm] (over reference); "
          f"screen {options.size} pixels for 2 m, probe {options.resolution}")  # fmt: skip
    print("roughness  reference" + "".join(f"{name:>16}" for name in columns))
    for r in roughness:
        reference, blurs = row_of(r, options, columns)
        cells = "".join(f"{f'{1000 * blur:.1f} ({blur / reference:.2f})':>16}" for blur in blurs)
        print(f"{r:9.2f}{1000 * reference:11.2f}{cells}", flush=True)
    print("\nalpha_t / alpha by the median angle, and the engine's fit")
    print(f"roughness{'one face':>12}{'fit':>10}{'two faces':>12}{'fit':>10}")
    for r in roughness:
        one, two = width_factors(r, IOR, options.rays)
        fits = [fitted_factor(r, IOR, both) for both in (False, True)]
        print(f"{r:9.2f}{one:12.4f}{fits[0]:10.4f}{two:12.4f}{fits[1]:10.4f}")


if __name__ == "__main__":
    main()
