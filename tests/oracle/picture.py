"""One pixel: the camera's ray, what it meets without any glass, the tree that grows from it, and their sum."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from refract_core.scene import Camera, Scene
from refract_core.settings import RenderSettings

from . import sampling
from .media import Media, media_around
from .screen import Found, by_proxy
from .shading import Shader, View
from .tiers import Leaf
from .tree import End, Grown, Ray, Tree
from .vec import ZERO, Vec, add, at, dot, scaled, sub, unit, vec
from .world import OPAQUE, Hit, first

Channels = list[float]


@dataclass
class Pixel:
    """Every plane of one pixel, by AOV name, and whether the last bit of a float may decide about them."""

    planes: dict[str, Channels]
    unsure: bool = False


class Sight(NamedTuple):
    """A ray of the camera."""

    origin: Vec
    direction: Vec
    cosine: float
    """to the camera's axis"""
    near: float
    far: float


_WEIGHTS = ("screen", "ray", "probe", "sky", "none")
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. ITU-R BT.709
_CLOSE = 1e-5
"""Relative: of two leaves whose weights are nearer than this, float32 may find either the stronger."""


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
        self.shader = Shader(scene, self.eye, settings.model)
        across = (self.window[1] - self.window[0]) / width
        self.jitters = sampling.jitters(settings.samples)
        self.spread = 0.0 if self.camera.orthographic else across / math.sqrt(settings.samples)
        """how much wider a sample's cone gets per metre"""
        self.marches = "screen" in settings.tiers
        """What is mirrored is marched for, which is not known here: planes that hold reflections are left out."""
        self.around: Media = () if self.camera.orthographic else media_around(self.shader, self.eye, settings.model)
        self.cut: float = getattr(settings, "cut", 0.02)
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

    def ray(self, px: float, py: float) -> Sight:
        """Through continuous pixel coordinates, y down."""
        left, right, bottom, top = self.window
        x = left + (right - left) * px / self.size[0]
        y = top - (top - bottom) * py / self.size[1]
        aside = add(scaled(self.right, x), scaled(self.up, y))
        near, far = self.camera.clipping
        if self.camera.orthographic:
            return Sight(add(self.eye, aside), self.forward, 1.0, near, far)
        d = unit(add(self.forward, aside))
        cosine = dot(d, self.forward)
        return Sight(self.eye, d, cosine, near / cosine, far / cosine)

    # --- One sample ---

    def _add_sample(self, sums: _Sums, x: int, y: int, k: int, nudge: tuple[float, float]) -> None:
        sight, view = self._through(x, y, k, nudge)
        tree = Tree(self.shader, self.settings, self.cut, self.spread, self.forward, self._on_screen(sight))
        ray = Ray(sight.origin, sight.direction, sight.near, far=sight.far, media=self.around)
        grown = tree.grow(ray, view, lambda hit: self._backdrop(sight, view, hit))
        sums.add("beauty", [*grown.color, 1.0 - grown.missing])
        if grown.glassy:
            self._note_glass(sums, grown, k)
        if k == 0:
            front, bare = grown.front, grown.bare
            t, n = (front.t, front.n) if front is not None else (math.inf, ZERO) if bare is None else (
                bare.t, bare.ng if dot(bare.ng, sight.direction) <= 0.0 else scaled(bare.ng, -1.0)
            )  # fmt: skip
            sums.keep("Z", [t * sight.cosine])
            sums.keep("N", list(n))

    def _through(self, x: int, y: int, k: int, nudge: tuple[float, float] = (0.0, 0.0)) -> tuple[Sight, View]:
        jx, jy = self.jitters[k]
        px, py = x + 0.5 + jx, y + 0.5 + jy
        view = View((x, y, 0), k, (x, y, k))
        return self.ray(px + nudge[0], py + nudge[1]), view

    def _first_opaque(self, sight: Sight, view: View) -> Hit | None:
        hits = self.shader.world.candidates(sight.origin, sight.direction, sight.near, sight.far, OPAQUE)
        return first(hits, self.shader.present(sight.origin, sight.direction, view.turn))

    def _backdrop(self, sight: Sight, view: View, hit: Hit | None) -> tuple[Vec, float]:
        """Colour and alpha of what stands behind all glass."""
        if hit is not None:
            hit = hit._replace(width=self.spread * hit.t)
            return self.shader.radiance(hit, sight.direction, view.key, view.sample), 1.0
        if self.shader.sky is not None:
            return self.shader.sky.radiance(sight.direction, 0.0), 1.0
        return ZERO, 0.0

    # --- The screen ---

    def _on_screen(self, sight: Sight) -> Callable[[Leaf, View, float], Callable[[], Found]]:
        """By the proxy of the scene's probe."""

        def asked(leaf: Leaf, view: View, t: float) -> Callable[[], Found]:
            def look(column: int, row: int) -> tuple[Vec, float, float]:
                return self._opaque_at(column, row, view.sample)

            own = (view.key[0] + 0.5, view.key[1] + 0.5, t * sight.cosine)
            return lambda: by_proxy(
                leaf.origin, leaf.direction, self.scene.probes[0].proxy, self.size, own, look,
                lambda p: self._project(p, view.sample),
            )  # fmt: skip

        return asked

    def _opaque_at(self, x: int, y: int, k: int) -> tuple[Vec, float, float]:
        """Colour, depth and coverage of the picture without its glass."""
        if (x, y, k) not in self._seen:
            sight, view = self._through(x, y, k)
            hit = self._first_opaque(sight, view)
            color, alpha = self._backdrop(sight, view, hit)
            self._seen[x, y, k] = color, math.inf if hit is None else hit.t * sight.cosine, alpha
        return self._seen[x, y, k]

    def _project(self, p: Vec, k: int) -> tuple[float, float, float]:
        """Pixel coordinates in the window of a sample, and depth."""
        v = sub(p, self.eye)
        z = dot(v, self.forward)
        w = 1.0 if self.camera.orthographic else z
        left, right, bottom, top = self.window
        jx, jy = self.jitters[k]
        px = (dot(v, self.right) / w - left) / (right - left) * self.size[0]
        py = (top - dot(v, self.up) / w) / (top - bottom) * self.size[1]
        return px - jx, py - jy, z

    # --- Planes ---

    def _note_glass(self, sums: _Sums, grown: Grown, k: int) -> None:
        sums.add("mask", [1.0])
        sums.add("refraction", list(grown.refraction))
        sums.add("reflection", list(grown.reflection))
        strengths = [sum(end.ray.clear) / 3.0 for end in grown.ends]
        total = sum(strengths)
        for s, end in zip(strengths, grown.ends, strict=True):
            share, answer = s / total, end.answer
            for name, w in zip(_WEIGHTS, (answer.screen, answer.ray, 0.0, answer.sky, answer.none), strict=True):
                sums.add(f"weight.{name}", [share * w])
            sums.add("confidence", [0.0 if end.lost else share * answer.confidence])
        sums.add("transmittance", [_left(grown.ends, c) for c in range(3)])
        if k == 0:
            sums.keep("thickness", [grown.front.thickness if grown.front is not None else 0.0])
            if grown.ends:
                self._note_strongest(sums, grown.ends)

    def _note_strongest(self, sums: _Sums, ends: list[End]) -> None:
        strengths = [dot(end.ray.clear, _LUMINANCE) for end in ends]
        most = max(strengths)
        way, layers = next((end.ray.way, end.ray.entered) for s, end in zip(strengths, ends, strict=True) if s == most)
        for s, end in zip(strengths, ends, strict=True):
            apart = end.ray.entered != layers or abs(end.ray.way - way) > _CLOSE * way
            if s > most * (1.0 - _CLOSE) and apart:
                self.shader.unsure = True
        sums.keep("path_length", [way])
        sums.keep("layers", [float(layers)])

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
        jx, jy = self.jitters[0]
        ray = self.ray(x + 0.5 + jx, y + 0.5 + jy)
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


def _left(ends: list[End], c: int) -> float:
    """Share of a channel's light that absorption leaves on its ways through."""
    clear = sum(end.ray.clear[c] for end in ends)
    return sum(end.ray.weight[c] for end in ends) / clear if clear > 0.0 else 1.0


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
