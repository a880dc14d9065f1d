"""Light that leaves an opaque surface: emission, lights with shadows, the environment, and one mirror bounce."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from refract_core.scene import Model, Param, Scene

from . import lights, optics, sampling
from .sampling import Key
from .sky import Sky, sky_of
from .surface import Surface, color, number, specular_albedo, surface_at
from .vec import ZERO, Vec, add, basis, clamp, cross, dot, mul, scaled, sub, unit, vec
from .world import GLASS, NEAR, OPAQUE, Hit, World, all_present, first

_MIRROR_ALPHA = 1e-3
_COAT_F0 = (0.04, 0.04, 0.04)
_LUMINANCE = (0.2126, 0.7152, 0.0722)


class View(NamedTuple):
    """What one pixel's rays share."""

    key: Key
    sample: int
    turn: tuple[int, int, int]
    """pixel and sample, which decide whether a partly present surface is there"""


class Gathered(NamedTuple):
    """What arrives at a surface."""

    irradiance: Vec
    highlights: Vec
    sky_seen: Vec
    """visibility of the environment by colour, times occlusion"""


class Shader:
    """A scene with all that lights it."""

    def __init__(self, scene: Scene, eye: Vec, override: str = "") -> None:
        """`override`: model of all glass, or none."""
        self.scene = scene
        self.override = override
        self.world = World(scene)
        self.sky = sky_of(scene.environment) if scene.environment is not None else None
        self.lamps = lights.lamps_of(scene, eye)
        self.unsure = False
        """Something hung on the last bits of a ray: a chance or a choice decided by them, a place behind many
        reflections."""

    # --- Rays ---

    def nearest(self, o: Vec, d: Vec, kinds: int, far: float = math.inf) -> Hit | None:
        """First present surface of a ray that starts on one."""
        return first(self.world.candidates(o, d, NEAR, far, kinds), self.present(o, d, None))

    def cover(self, hit: Hit) -> float:
        """Share of a place that is there: of a cut-out surface all where its opacity reaches the threshold, or none."""
        m = self.world.material(hit)
        if not m.cutout:
            return 1.0
        opacity = clamp(number(self.scene, hit._replace(width=0.0), m, Param.OPACITY))
        return float(opacity >= m.opacity_threshold) if m.opacity_threshold > 0.0 else opacity

    def present(self, o: Vec, d: Vec, turn: tuple[int, int, int] | None) -> Callable[[Hit], bool]:
        """Whether what a ray hits is there, asked for one hit after the other, nearest first. What is there by a share
        lets a ray on as long as more light is left behind it than a number that is tossed at the first such hit.
        `turn`: of the pixel's own rays and what they become, whose samples are a golden section apart; all others go
        by their bits, which are rounded on their way."""
        tossed: list[float] = []
        left = 1.0

        def there(hit: Hit) -> bool:
            nonlocal left
            cover = self.cover(hit)
            if cover in (0.0, 1.0):
                return cover == 1.0
            if not tossed:
                if turn is not None:
                    x, y, k = turn
                    first_turn = sampling.hashed(sampling.hashed(x, y, 0), hit.face.part, 0) / 2**32
                    tossed.append((first_turn + k * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0)
                else:
                    self.unsure = True
                    bits = ray_bits(o, d)
                    tossed.append(sampling.hashed(bits[0], bits[1], bits[2] ^ hit.face.part) / 2**32)
            left *= 1.0 - cover
            return 1.0 - tossed[0] > left

        return there

    def _arrives(self, surface: Surface, d: Vec, distance: float, casters: tuple[str, ...] | None = None) -> Vec:
        """Share of a light's point, straight through all glass on the way: what each wall lets pass, with air on its
        other side, and what bodies absorb between one wall and the next. `casters`: what is opaque and may be in the
        way; None: everything."""

        o, far = surface.point, distance * (1.0 - 1e-4)
        uncovered = 1.0
        for hit in self.world.candidates(o, d, NEAR, far, OPAQUE):
            if casters is None or hit.face.shape.path in casters:
                uncovered *= 1.0 - self.cover(hit)
        if uncovered == 0.0:
            return ZERO
        share, begun = (uncovered, uncovered, uncovered), 0.0
        for hit in all_present(self.world.candidates(o, d, NEAR, far, GLASS), self.present(o, d, None)):
            m = self.world.material(hit)
            model = Model[self.override.upper()] if self.override else m.model
            sheet = model is Model.THIN or (model is Model.TRACED and hit.face.sheet)
            ior, cosine = max(1.0, number(self.scene, hit, m, Param.IOR)), abs(dot(hit.ng, d))
            inwards = dot(hit.ng, d) < 0.0
            clear = 1.0 - optics.fresnel(cosine, 1.0 / ior)
            if sheet or inwards:
                clear *= 1.0 - clamp(number(self.scene, hit, m, Param.OPACITY))
            length = 0.0
            if sheet:
                length = optics.THIN / math.sqrt(1.0 - (1.0 - cosine * cosine) / (ior * ior))
            elif not inwards:
                length = hit.t - begun
            if not sheet:
                begun = hit.t
            tint = color(self.scene, hit, m, Param.TRANSMITTANCE)
            over = optics.THIN if sheet else m.absorption_distance
            left = optics.absorbed(tint, over, length) if length > 0.0 else (1.0, 1.0, 1.0)
            share = scaled(mul(share, left), clear)
        return share

    def path_of(self, thing: int) -> str:
        scene = self.scene
        of = scene.meshes[thing] if thing < len(scene.meshes) else scene.spheres[thing - len(scene.meshes)]
        return of.path

    # --- Light ---

    def gather(self, s: Surface, key: Key, sample: int, mirrored: Vec | None = None) -> Gathered:
        """`mirrored`: what the surface reflects of a lamp, where that is known better."""
        irradiance, highlights = ZERO, ZERO
        fresnel = mirrored or _lowered_schlick(s)
        coat = s.coat * (0.04 + 0.96 * (1.0 - clamp(dot(s.ns, s.wo))) ** 5)
        for k, lamp in enumerate(self.lamps):
            if lamp.lit is not None and self.path_of(s.thing) not in lamp.lit:
                continue
            even = lights.irradiance(lamp, s.point, s.ns) * lamp.diffuse
            gloss = lights.highlight(lamp, s.point, s.ns, s.wo, s.roughness**2) * lamp.specular
            over = coat * lights.highlight(lamp, s.point, s.ns, s.wo, s.coat_roughness**2) * lamp.specular
            if even + gloss + over <= 0.0:
                continue
            share = (1.0, 1.0, 1.0)
            if lamp.shadows:
                u1, u2 = sampling.pair(key, sample, sampling.FIRST_LIGHT + k)
                pick = sampling.pair(key, sample, sampling.LIGHT_PICK)[0]
                d, distance = lights.picked_target(lamp, s.point, s.ns, u1, u2, pick)
                shadow = lamp.shadow
                if shadow.distance < math.inf:
                    u = sampling.pair(key, sample, sampling.SHADOW_LENGTH)[0]
                    distance = min(distance, shadow.distance - shadow.falloff * u ** (1.0 / shadow.gamma))
                share = self._arrives(s, d, distance, lamp.casters)
            dark = lamp.shadow.color
            arrives = mul(lamp.radiance, vec([dark[c] + (1.0 - dark[c]) * share[c] for c in range(3)]))
            irradiance = add(irradiance, scaled(mul(arrives, lights.tint(lamp, s.point, s.ns)), even))
            base = vec([gloss * f for f in fresnel])
            for weight, roughness in ((base, s.roughness), ((over,) * 3, s.coat_roughness)):
                if max(weight) > 0.0:
                    shape = lights.mirrored_tint(lamp, s.point, s.ns, s.wo, roughness**2)
                    highlights = add(highlights, mul(mul(arrives, shape), weight))
        seen = ZERO
        if self.sky is not None:
            d, share = self._sky_direction(self.sky, s.ns, key, sample)
            seen = scaled(mul(share, self._arrives(s, d, math.inf)), s.occlusion)
            irradiance = add(irradiance, mul(self.sky.irradiance(s.ns), seen))
        return Gathered(irradiance, highlights, seen)

    def _sky_direction(self, sky: Sky, n: Vec, key: Key, sample: int) -> tuple[Vec, Vec]:
        """Where the environment's visibility is asked, and what arrives of its irradiance from all around if it is free
        there: bright directions, each kept with the chance of its cosine (von Neumann 1951)."""

        def by_cosine() -> Vec:
            x, y = basis(n)
            u1, u2 = sampling.pair(key, sample, sampling.SKY_COSINE)
            flat = add(scaled(x, math.cos(2.0 * math.pi * u2)), scaled(y, math.sin(2.0 * math.pi * u2)))
            return add(scaled(flat, math.sqrt(u1)), scaled(n, math.sqrt(1.0 - u1)))

        white = (1.0, 1.0, 1.0)
        if sky.even:  # then the cosine is all there is
            return by_cosine(), white
        for attempt in range(32):
            branch = key[2] if attempt == 0 else sampling.hashed(key[2], attempt - 1, 0)
            own = (key[0], key[1], branch)
            d = sky.drawn(*sampling.pair(own, sample, sampling.SKY_RADIANCE))
            if sampling.pair(own, sample, sampling.SKY_PICK)[0] < dot(d, n):
                if sample == 0:
                    return d, white
                e, light = sky.irradiance(n), sky.blurred(d)
                share = dot(e, _LUMINANCE) / dot(light, _LUMINANCE)
                return d, vec([share * light[c] / e[c] if e[c] > 0.0 else 0.0 for c in range(3)])
        return by_cosine(), white

    def radiance(self, hit: Hit, d: Vec, key: Key, sample: int) -> Vec:
        """Of an opaque hit, back along the ray that met it."""
        s = surface_at(self.scene, hit, scaled(d, -1.0))
        g = self.gather(s, key, sample)
        total = _without_gloss(s, g)
        strongest = max(s.f0)
        if strongest > 0.02 and s.roughness < (0.5 if strongest > 0.2 else 0.2):
            total = add(total, self._mirror(s, key, sample))
        else:
            total = add(total, self._sky_gloss(s, g, s.f0, s.roughness))
        if s.coat > 0.0:
            total = add(total, scaled(self._sky_gloss(s, g, _COAT_F0, s.coat_roughness), s.coat))
        return total

    def _mirror(self, s: Surface, key: Key, sample: int) -> Vec:
        """What a smooth surface shows, by one ray: emission, light and the environment's gloss there, no mirrors."""
        r = self._mirror_direction(s, key, sample)
        hit = self.nearest(s.point, r, OPAQUE)
        if hit is not None:
            there = surface_at(self.scene, hit, scaled(r, -1.0))
            g = self.gather(there, sampling.mirror_key(key), sample)
            light = add(_without_gloss(there, g), self._sky_gloss(there, g, there.f0, there.roughness))
        elif self.sky is not None:
            light = self.sky.radiance(r, 0.0)
        else:
            return ZERO
        return mul(light, specular_albedo(s.f0, s.roughness, _shown_cosine(s)))

    def _mirror_direction(self, s: Surface, key: Key, sample: int) -> Vec:
        h = s.ns
        if s.roughness**2 > _MIRROR_ALPHA:
            h = _visible_normal(s.ns, s.wo, s.roughness**2, *sampling.pair(key, sample, sampling.MIRROR))
        r = unit(sub(scaled(h, 2.0 * dot(h, s.wo)), s.wo))
        below = dot(r, s.ng)
        return unit(sub(r, scaled(s.ng, 2.0 * below))) if below < 0.0 else r

    def _sky_gloss(self, s: Surface, g: Gathered, f0: Vec, roughness: float) -> Vec:
        """The environment's mirror lobe, dimmed by the visibility found for its diffuse light."""
        if self.sky is None:
            return ZERO
        r = sub(scaled(s.ns, 2.0 * dot(s.ns, s.wo)), s.wo)
        return mul(mul(self.sky.lobe(r, roughness), specular_albedo(f0, roughness, _shown_cosine(s))), g.sky_seen)


def ray_bits(o: Vec, d: Vec) -> tuple[int, int, int]:
    x, y, z = (sampling.float_bits(c) for c in d)
    return x ^ sampling.float_bits(o[0]), y, z


def diffuse(s: Surface, g: Gathered) -> Vec:
    """Emission, and light without a direction."""
    return add(s.emissive, scaled(mul(s.albedo, g.irradiance), 1.0 / math.pi))


def _without_gloss(s: Surface, g: Gathered) -> Vec:
    return add(diffuse(s, g), g.highlights)


def _shown_cosine(s: Surface) -> float:
    return clamp(dot(s.ns, s.wo), 1e-3)


def _lowered_schlick(s: Surface) -> Vec:
    """Schlick, its grazing value lowered on rough surfaces (Lagarde 2011) and on those that hardly reflect."""
    x = (1.0 - clamp(dot(s.ns, s.wo))) ** 5
    top = (1.0 - s.roughness) * clamp(max(s.f0) / 0.02)
    return vec([f + (max(top, f) - f) * x for f in s.f0])


def _visible_normal(n: Vec, wo: Vec, alpha: float, u1: float, u2: float) -> Vec:
    """A microfacet normal among those seen from `wo` (Heitz, "Sampling the GGX Distribution of Visible Normals",
    JCGT 7(4) 2018, listing 1)."""
    x, y = basis(n)
    v = unit((alpha * dot(wo, x), alpha * dot(wo, y), dot(wo, n)))
    flat = math.hypot(v[0], v[1])
    t1 = (-v[1] / flat, v[0] / flat, 0.0) if flat > 0.0 else (1.0, 0.0, 0.0)
    t2 = cross(v, t1)
    r, phi, s = math.sqrt(u1), 2.0 * math.pi * u2, (1.0 + v[2]) / 2.0
    a = r * math.cos(phi)
    b = (1.0 - s) * math.sqrt(1.0 - a * a) + s * r * math.sin(phi)
    h = add(add(scaled(t1, a), scaled(t2, b)), scaled(v, math.sqrt(max(0.0, 1.0 - a * a - b * b))))
    h = unit((alpha * h[0], alpha * h[1], max(1e-6, h[2])))
    return unit(add(add(scaled(x, h[0]), scaled(y, h[1])), scaled(n, h[2])))
