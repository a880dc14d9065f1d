"""One pixel: the camera's ray, the opaque surface it ends on, the glass it enters on the way, and their sum."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from refract_core.scene import Camera, Model, Param, Scene
from refract_core.settings import RenderSettings

from . import optics, sampling
from .screen import NOTHING, Found, by_proxy
from .shading import Shader, View, diffuse, ray_bits
from .surface import Surface, number, surface_at
from .tiers import Answer, Leaf, ask
from .vec import ZERO, Vec, add, at, clamp, dot, mul, scaled, sub, unit, vec
from .walk import Entry, Exit, Status, entry_at, exit_of
from .world import GLASS, OPAQUE, Hit, all_present, first

Channels = list[float]


@dataclass
class Pixel:
    """Every plane of one pixel, by AOV name, and whether the last bit of a float may decide about them."""

    planes: dict[str, Channels]
    unsure: bool = False


class Ray(NamedTuple):
    """Of the camera."""

    origin: Vec
    direction: Vec
    cosine: float
    """to the camera's axis"""
    near: float
    far: float


class Layer(NamedTuple):
    """One refractive surface, composited."""

    color: Vec
    alpha: float
    refraction: Vec
    reflection: Vec
    surface: Surface
    entry: Entry
    exit: Exit
    answer: Answer


_WEIGHTS = ("screen", "ray", "probe", "sky", "none")


class Oracle:
    """A scene, a camera and settings, ready to be asked pixel by pixel."""

    def __init__(self, scene: Scene, settings: RenderSettings, width: int, height: int) -> None:
        named = [c for c in scene.cameras if settings.camera in (c.path, c.path.rpartition("/")[2])]
        self.camera: Camera = named[0] if settings.camera else scene.cameras[0]
        self.scene, self.settings, self.size = scene, settings, (width, height)
        m = self.camera.world_from_camera
        self.right, self.up, back, self.eye = (vec(m[:3, c]) for c in range(4))
        self.forward = scaled(back, -1.0)
        self.window = _conformed(self.camera.window, width, height)
        self.shader = Shader(scene, self.eye)
        across = (self.window[1] - self.window[0]) / width
        self.spread = 0.0 if self.camera.orthographic else across
        """how much wider a pixel's cone gets per metre"""
        self.marches = "screen" in settings.tiers
        """What is mirrored is marched for, which is not known here: planes that hold reflections are left out."""
        if self.marches and (settings.screen != "proxy" or settings.max_layers > 1 or len(scene.probes) != 1):
            raise NotImplementedError("the screen is known by proxy, with one layer and one probe that lends its proxy")
        self._seen: dict[tuple[int, int, int], tuple[Vec, float, float]] = {}

    def pixel(self, x: int, y: int, nudge: tuple[float, float] = (0.0, 0.0)) -> Pixel:
        """`nudge`: look beside the sample, by so many pixels, with the very same random numbers."""
        self.shader.unsure = False
        sums = _Sums()
        for k in range(self.settings.samples):
            self._add_sample(sums, x, y, k, nudge)
        planes = self._finished(sums, x, y)
        if self.marches and planes["mask"][0] > 0.0:
            del planes["beauty"], planes["reflection"]
        return Pixel(planes, self.shader.unsure)

    # --- The camera ---

    def ray(self, px: float, py: float) -> Ray:
        """Through continuous pixel coordinates, y down."""
        left, right, bottom, top = self.window
        x = left + (right - left) * px / self.size[0]
        y = top - (top - bottom) * py / self.size[1]
        aside = add(scaled(self.right, x), scaled(self.up, y))
        near, far = self.camera.clipping
        if self.camera.orthographic:
            return Ray(add(self.eye, aside), self.forward, 1.0, near, far)
        d = unit(add(self.forward, aside))
        cosine = dot(d, self.forward)
        return Ray(self.eye, d, cosine, near / cosine, far / cosine)

    # --- One sample ---

    def _add_sample(self, sums: _Sums, x: int, y: int, k: int, nudge: tuple[float, float]) -> None:
        ray, view = self._through(x, y, k, nudge)
        opaque = self._first_opaque(ray, view)
        entries = self._entries(ray, view, ray.far if opaque is None else opaque.t)
        alpha, color, z, n = self._backdrop(ray, view, opaque)
        layers = [self._layer(ray, view, hit) for hit in entries]
        for layer in reversed(layers):
            color, alpha = layer.color, layer.alpha
        sums.add("beauty", [*color, alpha])
        if layers:
            self._note_glass(sums, layers[0], k)
            z, n = entries[0].t * ray.cosine, layers[0].surface.ns
        if k == 0:
            sums.keep("layers", [float(len(layers))])
            sums.keep("Z", [z])
            sums.keep("N", list(n))

    def _through(self, x: int, y: int, k: int, nudge: tuple[float, float] = (0.0, 0.0)) -> tuple[Ray, View]:
        jx, jy = sampling.jitter(k)
        px, py = x + 0.5 + jx, y + 0.5 + jy
        straight = self.ray(px, py)
        view = View((x, y, 0), k, ray_bits(straight.origin, straight.direction))
        return self.ray(px + nudge[0], py + nudge[1]), view

    def _first_opaque(self, ray: Ray, view: View) -> Hit | None:
        hits = self.shader.world.candidates(ray.origin, ray.direction, ray.near, ray.far, OPAQUE)
        return first(hits, lambda h: self.shader.present(h, ray.origin, ray.direction, view.bits))

    def _entries(self, ray: Ray, view: View, until: float) -> list[Hit]:
        """Refractive surfaces that the ray enters, nearest first: either side of a pane, the outside of a solid."""
        hits = self.shader.world.candidates(ray.origin, ray.direction, ray.near, until, GLASS)
        seen = all_present(hits, lambda h: self.shader.present(h, ray.origin, ray.direction, view.bits))
        entered = [h for h in seen if self._enters(h, ray.direction)]
        return [self._with_width(h) for h in entered[: self.settings.max_layers]]

    def _enters(self, hit: Hit, d: Vec) -> bool:
        pane = hit.face.sheet or self.shader.world.material(hit).model is Model.THIN
        return pane or dot(hit.ng, d) < 0.0

    def _with_width(self, hit: Hit) -> Hit:
        return hit._replace(width=self.spread * hit.t)

    def _backdrop(self, ray: Ray, view: View, hit: Hit | None) -> tuple[float, Vec, float, Vec]:
        """Alpha, colour, depth and normal of what stands behind all glass."""
        if hit is not None:
            color = self.shader.radiance(self._with_width(hit), ray.direction, view.key, view.sample)
            ng = hit.ng if dot(hit.ng, ray.direction) <= 0.0 else scaled(hit.ng, -1.0)
            return 1.0, color, hit.t * ray.cosine, ng
        if self.shader.sky is not None:
            return 1.0, self.shader.sky.radiance(ray.direction, 0.0), math.inf, ZERO
        return 0.0, ZERO, math.inf, ZERO

    # --- Glass ---

    def _layer(self, ray: Ray, view: View, hit: Hit) -> Layer:
        """What comes through replaces the diffuse light by 1 - opacity; reflection and highlights are added whole."""
        s = surface_at(self.scene, hit, scaled(ray.direction, -1.0))
        if dot(s.ns, ray.direction) >= 0.0:
            s = s._replace(ns=s.ng)
        gathered = self.shader.gather(s, view.key, view.sample)
        entry = entry_at(self.scene, hit, self.settings.model)
        through, exit_, answer = self._transmitted(s, entry, view, hit.t * ray.cosine)
        share = optics.fresnel(clamp(dot(s.ns, s.wo)), entry.medium.ior)
        m = self.scene.materials[hit.face.material]
        opacity = clamp(number(self.scene, hit, m, Param.OPACITY))
        clear = (1.0 - opacity) * (1.0 - share)
        refraction = scaled(through, clear)
        reflection = add(scaled(self._reflected(s, view).color, share), gathered.highlights)
        color = add(add(refraction, reflection), scaled(diffuse(s, gathered), opacity))
        return Layer(color, 1.0 - answer.none * clear, refraction, reflection, s, entry, exit_, answer)

    def _transmitted(self, s: Surface, entry: Entry, view: View, z: float) -> tuple[Vec, Exit, Answer]:
        """Light from behind, channel by channel under dispersion; the green ray stands for all in the data planes."""
        indices = optics.iors(entry.medium.ior, entry.abbe)
        hdrp = self.settings.screen == "proxy"
        rough = optics.transmitted_roughness(s.roughness, entry.medium.ior)
        found = {}
        for ior in set(indices):
            exit_ = exit_of(self.shader, s, entry, ior, measured=not hdrp)
            seen_as = s.roughness if hdrp else rough
            embedded = exit_.status is Status.EMBEDDED
            leaf = Leaf(exit_.point, exit_.direction, _tangent(rough), seen_as, embedded)
            found[ior] = exit_, ask(self.shader, leaf, self.settings.tiers, view, self._on_screen(leaf, view, z))
        light = [mul(found[ior][1].color, found[ior][0].transmittance)[c] for c, ior in enumerate(indices)]
        return vec(light), *found[indices[1]]

    def _reflected(self, s: Surface, view: View) -> Answer:
        r = optics.mirrored(scaled(s.wo, -1.0), s.ns)
        if dot(r, s.ng) <= 0.0:
            r = optics.mirrored(scaled(s.wo, -1.0), s.ng)
        tiers = tuple(tier for tier in self.settings.tiers if tier != "screen")
        leaf = Leaf(s.point, r, _tangent(s.roughness), s.roughness)
        return ask(self.shader, leaf, tiers, view, lambda: NOTHING)

    # --- The screen ---

    def _on_screen(self, leaf: Leaf, view: View, z: float) -> Callable[[], Found]:
        """By the proxy of the scene's probe."""

        def look(column: int, row: int) -> tuple[Vec, float, float]:
            return self._opaque_at(column, row, view.sample)

        own = (view.key[0] + 0.5, view.key[1] + 0.5, z)
        return lambda: by_proxy(
            leaf.origin, leaf.direction, self.scene.probes[0].proxy, self.size, own, look,
            lambda p: self._project(p, view.sample),
        )  # fmt: skip

    def _opaque_at(self, x: int, y: int, k: int) -> tuple[Vec, float, float]:
        """Colour, depth and coverage of the picture without its glass."""
        if (x, y, k) not in self._seen:
            ray, view = self._through(x, y, k)
            alpha, color, z, _ = self._backdrop(ray, view, self._first_opaque(ray, view))
            self._seen[x, y, k] = color, z, alpha
        return self._seen[x, y, k]

    def _project(self, p: Vec, k: int) -> tuple[float, float, float]:
        """Pixel coordinates in the window of a sample, and depth."""
        v = sub(p, self.eye)
        z = dot(v, self.forward)
        w = 1.0 if self.camera.orthographic else z
        left, right, bottom, top = self.window
        jx, jy = sampling.jitter(k)
        px = (dot(v, self.right) / w - left) / (right - left) * self.size[0]
        py = (top - dot(v, self.up) / w) / (top - bottom) * self.size[1]
        return px - jx, py - jy, z

    # --- Planes ---

    def _note_glass(self, sums: _Sums, front: Layer, k: int) -> None:
        answer, exit_ = front.answer, front.exit
        sums.add("mask", [1.0])
        shares = (answer.screen, answer.ray, 0.0, answer.sky, answer.none)
        for name, w in zip(_WEIGHTS, shares, strict=True):
            sums.add(f"weight.{name}", [w])
        sums.add("refraction", list(front.refraction))
        sums.add("reflection", list(front.reflection))
        sums.add("transmittance", list(exit_.transmittance))
        sums.add("confidence", [answer.confidence if exit_.status is not Status.LOST else 0.0])
        if k == 0:
            sums.keep("thickness", [front.entry.thickness])
            sums.keep("path_length", [exit_.path])

    def _finished(self, sums: _Sums, x: int, y: int) -> dict[str, Channels]:
        """Means; colours by exposure, lengths in the stage's units, places and normals in its world."""
        share = 1.0 / self.settings.samples
        light = self.camera.exposure_scale * 2.0**self.settings.exposure * share
        unit_ = 1.0 / self.scene.metres_per_unit
        covered = sums.of("mask", 1)[0]
        planes = {"mask": [covered * share], "layers": sums.of("layers", 1)}
        r, g, b, a = sums.of("beauty", 4)
        planes["beauty"] = [r * light, g * light, b * light, a * share]
        for name in ("refraction", "reflection"):
            planes[name] = [v * light for v in sums.of(name, 3)]
        for name, count in (("transmittance", 3), ("confidence", 1), *((f"weight.{w}", 1) for w in _WEIGHTS)):
            planes[name] = [v / covered if covered else 0.0 for v in sums.of(name, count)]
        for name in ("Z", "thickness", "path_length"):
            planes[name] = [v * unit_ for v in sums.of(name, 1)]
        planes["N"], planes["P"] = self._in_stage(sums, x, y)
        return planes

    def _in_stage(self, sums: _Sums, x: int, y: int) -> tuple[Channels, Channels]:
        z = sums.of("Z", 1)[0]
        if z == math.inf:
            return sums.of("N", 3), [0.0] * 3
        ray = self.ray(x + 0.5, y + 0.5)
        p = at(ray.origin, ray.direction, z / ray.cosine)
        rows = [[float(v) for v in row] for row in self.scene.stage_from_engine[:3]]
        size = abs(_determinant(rows)) ** (1.0 / 3.0)
        n = vec(sums.of("N", 3))
        normal = [dot(vec(row[:3]), n) / size for row in rows]
        return normal, [dot(vec(row[:3]), p) + row[3] for row in rows]


class _Sums:
    """Planes in the making."""

    def __init__(self) -> None:
        self._planes: dict[str, Channels] = {}

    def add(self, name: str, values: Channels) -> None:
        old = self._planes.get(name, [0.0] * len(values))
        self._planes[name] = [a + b for a, b in zip(old, values, strict=True)]

    def keep(self, name: str, values: Channels) -> None:
        self._planes[name] = values

    def of(self, name: str, count: int) -> Channels:
        return self._planes.get(name, [0.0] * count)


def _tangent(roughness: float) -> float:
    """Of the half angle of a lobe's cone: twice the median slope, which is alpha."""
    return 2.0 * roughness**2


def _conformed(window: tuple[float, float, float, float], width: int, height: int) -> tuple[float, float, float, float]:
    """The window grown about its middle until its pixels are square."""
    left, right, bottom, top = window
    w, h = right - left, top - bottom
    wide = max(w, h * width / height)
    high = max(h, w * height / width)
    x, y = (left + right) / 2, (bottom + top) / 2
    return x - wide / 2, x + wide / 2, y - high / 2, y + high / 2


def _determinant(m: list[list[float]]) -> float:
    a, b, c = (vec(row[:3]) for row in m)
    return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
