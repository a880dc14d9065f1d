"""A pixel's rays: at every interface light goes both ways, and every ray that ends asks the tiers.

The rules are numbered as in docs/decisions/one-tree.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from refract_core.scene import Model, Param
from refract_core.settings import RenderSettings

from . import lights, optics, sampling
from .media import (
    MOST,
    Media,
    Medium,
    disperses,
    filling,
    index,
    medium_at,
    model_at,
    thickness_at,
    without,
)
from .optics import Passage, Split, absorbed
from .screen import NOTHING, Found
from .shading import Shader, View, diffuse
from .surface import Surface, number, surface_at
from .tiers import Answer, Leaf, ask
from .vec import ZERO, Vec, add, clamp, dot, mul, scaled, sub, unit
from .world import GLASS, NEAR, OPAQUE, Hit, first

_MOST_MET = 128
_LATE = 96
"""After so many a ray is let out at the next occasion."""
_FAINT = 1.0 / 32.0
_FORGOTTEN = 16
"""After so many interfaces, each of which may double an error, float32 does not say any more where a ray is."""
_HEEDED = 1e-3
"""Of a pixel's light; what weighs less may be elsewhere, or not be."""
_CLOSE = 1e-5
"""Relative: numbers nearer than this may compare the other way in float32."""
_BESIDE = (1e-5, 1e-6)
"""How far from a surface a ray starts that leaves it: relative to the place, and in metres."""
_CONTACT = (4e-5, 4e-6)
"""Glass stands on a table where they are nearer than this: relative to the place, and in metres."""

WHITE: Vec = (1.0, 1.0, 1.0)


class Side(Enum):
    """Of the first interface, which way a ray has gone there."""

    VIEW = 0
    """has met none"""
    THROUGH = 1
    MIRRORED = 2


class Step(Enum):
    """What a surface of glass is to a ray."""

    PANE = 3
    TYPED = 4
    ENTERS = 5
    LEAVES = 6
    PASSES = 7


class Inner(NamedTuple):
    """A typed model's way, while a ray looks along it."""

    body: Medium
    passage: Passage
    beyond: bool = False
    """the wall of the real body has been passed"""


class Ray(NamedTuple):
    origin: Vec
    direction: Vec
    start: float = 0.0
    """along the direction, from where it looks [m]"""
    begun: float = 0.0
    """up to where the media have absorbed already [m]"""
    far: float = math.inf
    weight: Vec = WHITE
    clear: Vec = WHITE
    """the weight without absorption"""
    channel: int = -1
    """the only one it carries; -1: all"""
    media: Media = ()
    side: Side = Side.VIEW
    blur: float = 0.0
    """tangent of the half angle of its cone"""
    roughness: float = 0.0
    entered: int = 0
    met: int = 0
    lamps: bool = False
    """it has been mirrored in glass, and sees them"""
    thing: int = -1
    """that it entered last"""
    way: float = 0.0
    """inside media, so far [m]"""
    travelled: float = 0.0
    """from the eye to the origin [m]"""
    branch: int = 0
    inner: Inner | None = None

    def absorb(self, t: float) -> Ray:
        """What fills the space, up to a distance; at first from the eye, wherever the near plane is."""
        medium = filling(self.media)
        if medium is None:
            return self._replace(begun=t)
        left = absorbed(medium.tint, medium.distance, t - self.begun)
        return self._replace(weight=mul(self.weight, left), way=self.way + t - self.begun, begun=t)

    def passed(self, t: float, media: Media) -> Ray:
        """On behind a surface that is nothing to it."""
        return self._replace(start=t, media=media, met=self.met + 1)


class End(NamedTuple):
    """A leaf, answered."""

    ray: Ray
    answer: Answer
    lost: bool


class Front(NamedTuple):
    """The first surface that was entered or left."""

    t: float
    n: Vec
    thickness: float


@dataclass
class Grown:
    """What the tree of one sample brings."""

    color: Vec = ZERO
    refraction: Vec = ZERO
    reflection: Vec = ZERO
    missing: float = 0.0
    ends: list[End] = field(default_factory=list)
    """of rays that went through"""
    front: Front | None = None
    bare: Hit | None = None
    """what the view ray ended on"""
    glassy: bool = False

    def gain(self, side: Side, light: Vec) -> None:
        self.color = add(self.color, light)
        if side is Side.MIRRORED:
            self.reflection = add(self.reflection, light)
        else:
            self.refraction = add(self.refraction, light)


class Choice(NamedTuple):
    """What a hit is to a ray: the ray as it arrives, the step, the body's own medium, the media behind."""

    ray: Ray
    step: Step
    body: Medium | None
    behind: Media


OnScreen = Callable[[Leaf, View, float], Callable[[], Found]]
Light = Callable[[Hit | None], tuple[Vec, float]]
"""Colour and alpha of what a view ray meets without any glass."""


class Tree:
    """Grows one sample's tree."""

    def __init__(
        self, shader: Shader, settings: RenderSettings, cut: float, spread: float, ahead: Vec, on_screen: OnScreen
    ) -> None:
        self.shader, self.scene, self.settings = shader, shader.scene, settings
        self.cut, self.spread, self.ahead, self.on_screen = cut, spread, ahead, on_screen
        self.by_proxy = settings.screen == "proxy"

    def grow(self, ray: Ray, view: View, light: Light) -> Grown:
        grown = Grown(glassy=bool(ray.media))
        waiting = [ray]
        while waiting:
            ray = waiting.pop()
            waiting.extend(reversed(self._go(ray, view, light, grown)))
        return grown

    def _go(self, ray: Ray, view: View, light: Light, grown: Grown) -> list[Ray]:
        """One ray to the next thing that it meets; the rays that go on from there."""
        if ray.met >= _MOST_MET:
            self._end(ray, None, view, grown, lost=True)
            return []
        hit = self._met(ray, view)
        if ray.lamps and ray.blur <= 0.0 and self._lit(ray, hit, grown):
            return []
        if hit is None and ray.inner is not None:
            return [_out(ray.absorb(ray.far), ray.inner)]
        if hit is None or hit.face.kind == OPAQUE:
            if ray.side is Side.VIEW:
                grown.bare = hit
            if ray.side is Side.VIEW and not grown.glassy:
                grown.color, alpha = light(hit)
                grown.missing = 1.0 - alpha
            else:
                self._end(ray, hit, view, grown)
            return []
        choice = self._choice(ray, hit)
        ray = choice.ray.absorb(hit.t)
        if choice.step is Step.PASSES:
            if ray.inner is not None and hit.face.thing == ray.inner.body.thing:
                ray = ray._replace(inner=ray.inner._replace(beyond=dot(hit.ng, ray.direction) > 0.0))
            return [ray.passed(hit.t, choice.behind)]
        if choice.step is not Step.LEAVES:
            ray = ray._replace(media=_still_in(ray))
        return self._split(ray, hit, choice, view, grown)

    def _lit(self, ray: Ray, hit: Hit | None, grown: Grown) -> bool:
        """A lamp ends the ray before anything else does."""
        path = self.shader.path_of(ray.thing)
        seen = [lamp for lamp in self.shader.lamps if lamp.specular > 0.0 and (lamp.lit is None or path in lamp.lit)]
        far = [(lights.distance_to(lamp, ray.origin, ray.direction), k) for k, lamp in enumerate(seen)]
        t, k = min(far, default=(math.inf, -1))
        if not ray.start < t < (ray.far if hit is None else hit.t):
            return False
        ray = ray.absorb(t)
        grown.gain(ray.side, mul(ray.weight, lights.seen(seen[k], ray.origin, ray.direction)))
        return True

    # --- What it meets ---

    def _met(self, ray: Ray, view: View) -> Hit | None:
        bare = not ray.media and ray.entered >= self.settings.max_layers
        kinds = OPAQUE if bare else OPAQUE | GLASS
        hit = first(self._candidates(ray, ray.start, ray.far, kinds), self._present(ray, view))
        if hit is None or hit.face.kind == OPAQUE:
            return hit
        if ray.media or (ray.entered > 0 and dot(hit.ng, ray.direction) > 0.0):  # rule 2
            near = _CONTACT[0] * max(abs(c) for c in hit.point) + _CONTACT[1]
            touching = self._candidates(ray, max(0.0, hit.t - near), hit.t + near, OPAQUE)
            hit = first(touching, self._present(ray, view)) or hit
        return hit

    def _candidates(self, ray: Ray, start: float, far: float, kinds: int) -> list[Hit]:
        hits = self.shader.world.candidates(ray.origin, ray.direction, start + NEAR, far, kinds)
        return [hit._replace(width=self.spread * (ray.travelled + hit.t)) for hit in hits]

    def _present(self, ray: Ray, view: View) -> Callable[[Hit], bool]:
        return self.shader.present(ray.origin, ray.direction, view.turn)

    def _choice(self, ray: Ray, hit: Hit) -> Choice:
        """Rules 3 to 7."""
        thing, media = hit.face.thing, ray.media
        inner = dot(hit.ng, ray.direction) > 0.0
        model = model_at(self.scene, hit, self.settings.model)
        within = any(m.thing == thing for m in media)
        straight = Choice(ray, Step.PASSES, None, media)
        still = _still_in(ray)
        if model is Model.THIN:
            return Choice(ray, Step.PANE, medium_at(self.scene, hit, model), still)
        outer = not inner if model is Model.TRACED else (not inner or hit.face.sheet) and not within
        if outer:
            if len(media) >= MOST:
                return straight
            body = medium_at(self.scene, hit, model)
            before = filling(media)
            if model is not Model.TRACED:
                before = filling(still)
                if before is not None:  # whatever is around, along the stretch it is the model's body that counts
                    body = body._replace(priority=max(body.priority, before.priority))
                return Choice(ray, Step.TYPED, body, (*still, body))
            behind = (*media, body)
            again = before is not None and before.thing == thing
            if filling(behind) is body and not again:
                return Choice(ray, Step.ENTERS, body, (*still, body))
            return Choice(ray, Step.PASSES, body, behind)
        if inner and not within and self._is_cut(ray, hit, model):
            media = (*media, medium_at(self.scene, hit, model))
            within, ray = True, ray._replace(media=media)
        given_up = ray.inner is None or ray.inner.body.thing != thing
        if not (inner and within and given_up):
            return straight
        body, behind = without(media, thing)
        return Choice(ray, Step.LEAVES if filling(media) is body else Step.PASSES, body, behind)

    @staticmethod
    def _is_cut(ray: Ray, hit: Hit, model: Model) -> bool:
        """The near plane lies in the body."""
        solid = model is Model.TRACED and not hit.face.sheet
        return solid and ray.side is Side.VIEW and ray.met == 0 and len(ray.media) < MOST

    # --- What an interface does ---

    def _split(self, ray: Ray, hit: Hit, choice: Choice, view: View, grown: Grown) -> list[Ray]:
        d, step = ray.direction, choice.step
        s = surface_at(self.scene, hit, scaled(d, -1.0))
        if dot(s.ns, d) >= 0.0:
            s = s._replace(ns=s.ng)
        model = model_at(self.scene, hit, self.settings.model)
        if grown.front is None:
            grown.front = Front(hit.t, s.ns, thickness_at(self.scene, hit, model))
            grown.glassy = True
        opacity = 0.0
        if step is not Step.LEAVES:
            m = self.scene.materials[hit.face.material]
            opacity = clamp(number(self.scene, hit, m, Param.OPACITY))

        before = filling(ray.media)
        after = choice.body if step in (Step.PANE, Step.TYPED) else filling(choice.behind)
        apart = ray.channel < 0 and (disperses(before) or disperses(after))
        channels = (0, 1, 2) if apart else (ray.channel,)
        ways = []
        for c in channels:
            eta = index(before, c) / index(after, c)
            split = self._of_channel(ray, s, step, eta)
            ways.append(_Way(c, _only(c) if apart else WHITE, 1.0 / eta, split))
        mirrored = [way.split.reflectance for way in ways] * (1 if apart else 3)
        if step is not Step.LEAVES:
            self._shine(ray, s, opacity, (mirrored[0], mirrored[1], mirrored[2]), view, grown)
        whole = _Part(ray.weight, ray.clear)
        back = whole.by((mirrored[0], mirrored[1], mirrored[2]))
        through = [whole.by(scaled(w.mask, (1.0 - w.split.reflectance) * (1.0 - opacity))) for w in ways]
        back, through = self._cut(back, through, ways, ray.met)

        rays = []
        for way, part in zip(ways, through, strict=True):
            if max(part.weight) > 0.0:
                child = self._follower(ray, hit.t, s, part, sampling.THROUGH)._replace(channel=way.channel)
                rays.append(self._through(child, hit, s, choice, way))
        if max(back.weight) > 0.0:
            child = self._follower(ray, hit.t, s, back, sampling.GLANCED)
            blur = math.hypot(ray.blur, 2.0 * s.roughness**2)
            entered = ray.entered + (step is not Step.LEAVES)
            child = child._replace(direction=optics.glanced(d, s.ns, s.ng), blur=blur, entered=entered)
            if step is not Step.LEAVES:
                child = child._replace(thing=hit.face.thing)
            rays.append(_beside(child._replace(lamps=step is Step.LEAVES), s))
        return rays

    def _of_channel(self, ray: Ray, s: Surface, step: Step, eta: float) -> Split:
        d = ray.direction
        beyond = eta * eta * (1.0 - dot(d, s.ns) ** 2)
        if eta > 1.0 and abs(1.0 - beyond) < _CLOSE and max(ray.weight) >= _HEEDED:
            self.shader.unsure = True
        if step in (Step.ENTERS, Step.LEAVES):
            return optics.crossing(d, s.ns, s.ng, eta)
        return Split(None, optics.fresnel(clamp(-dot(d, s.ns)), eta))

    def _cut(
        self, back: _Part, through: list[_Part], ways: list[_Way], met: int
    ) -> tuple[_Part, list[_Part]]:
        """What weighs too little goes the way of the rest, and what runs round for long is let out. Channels that are
        totally reflected have no way through: they stay mirrored."""
        r, t = max(back.weight), max(sum(part.weight[c] for part in through) for c in range(3))
        self._doubt(r, t)
        if t > 0.0 and (r < self.cut or met >= _LATE):
            rest = back
            for k, way in enumerate(ways):
                if way.split.reflectance < 1.0:
                    through[k] = through[k].plus(back.by(way.mask))
                    rest = rest.by(sub(WHITE, way.mask))
            return rest, through
        if t < self.cut * _FAINT:
            for part in through:
                back = back.plus(part)
            return back, [_Part(ZERO, ZERO)] * len(through)
        return back, through

    def _doubt(self, r: float, t: float) -> None:
        if max(r, t) < _HEEDED:
            return
        if abs(r - self.cut) < _CLOSE * self.cut or abs(t - self.cut * _FAINT) < _CLOSE * self.cut:
            self.shader.unsure = True

    @staticmethod
    def _follower(ray: Ray, t: float, s: Surface, part: _Part, step: int) -> Ray:
        """What both ways have in common; as it is, it goes back into the media it came from."""
        way = Side.THROUGH if step == sampling.THROUGH else Side.MIRRORED
        return ray._replace(
            origin=s.point, start=0.0, begun=0.0, far=math.inf, weight=part.weight, clear=part.clear, inner=None,
            side=way if ray.side is Side.VIEW else ray.side, roughness=max(ray.roughness, s.roughness),
            met=ray.met + 1, branch=sampling.branched(ray.branch, step), travelled=ray.travelled + t,
        )  # fmt: skip

    def _through(self, child: Ray, hit: Hit, s: Surface, choice: Choice, way: _Way) -> Ray:
        step, body, bent = choice.step, choice.body, way.split.transmitted
        if step is Step.LEAVES:
            assert bent is not None
            return _beside(child._replace(direction=bent, media=choice.behind), s)
        assert body is not None
        rough = 2.0 * optics.transmitted_roughness(s.roughness, body.ior) ** 2
        child = child._replace(
            blur=math.hypot(child.blur, rough), entered=child.entered + 1, thing=hit.face.thing
        )
        if step is Step.ENTERS:
            assert bent is not None
            return _beside(child._replace(direction=bent, media=choice.behind), s)
        model = model_at(self.scene, hit, self.settings.model)
        passage = _passage(model, s, max(way.ratio, 1.0), thickness_at(self.scene, hit, model))
        if step is Step.PANE:
            left = absorbed(body.tint, body.distance, passage.path)
            return child._replace(
                weight=mul(child.weight, left), way=child.way + passage.path, origin=passage.point,
                direction=passage.direction, travelled=child.travelled + passage.path,
            )  # fmt: skip
        child = child._replace(media=choice.behind)
        if passage.path == 0.0:  # it starts on the surface that it is to leave
            return _beside(_out(child, Inner(body, passage)), s)
        if self.by_proxy:
            return _out(child.absorb(passage.path), Inner(body, passage))
        inside = unit(sub(passage.point, s.point))
        return _beside(child._replace(direction=inside, far=passage.path, inner=Inner(body, passage)), s)

    def _shine(self, ray: Ray, s: Surface, opacity: float, mirrored: Vec, view: View, grown: Grown) -> None:
        """Of the surface itself. What the first one sends out by itself is in neither of the planes."""
        gathered = self.shader.gather(s, _key(view, ray), view.sample, mirrored)
        own = mul(ray.weight, scaled(diffuse(s, gathered), opacity))
        # The lamp that stands in at the eye has no highlights in glass.
        gleams = any(lamp.kind is not None and lamp.specular > 0.0 for lamp in self.shader.lamps)
        highlights = mul(ray.weight, gathered.highlights) if gleams else ZERO
        if ray.side is Side.VIEW:
            grown.color = add(grown.color, own)
            grown.gain(Side.MIRRORED, highlights)
        else:
            grown.gain(ray.side, add(own, highlights))

    # --- Leaves ---

    def _end(self, ray: Ray, hit: Hit | None, view: View, grown: Grown, lost: bool = False) -> None:
        embedded = hit is not None and bool(ray.media)
        if hit is not None:
            ray = ray.absorb(hit.t)
        if ray.met >= _FORGOTTEN and max(ray.weight) >= _HEEDED:
            self.shader.unsure = True
        back = ray.side is Side.MIRRORED
        gloss = ray.roughness if self.by_proxy and not back else math.sqrt(min(1.0, 0.5 * ray.blur))
        leaf = Leaf(ray.origin, ray.direction, ray.blur, gloss, hit, embedded)
        own = view._replace(key=_key(view, ray))
        tiers = tuple(t for t in self.settings.tiers if not (back and t == "screen"))
        z = grown.front.t if grown.front is not None else math.inf
        on_screen = (lambda: NOTHING) if back else self.on_screen(leaf, own, z)
        answer = ask(self.shader, leaf, tiers, own, on_screen)
        grown.gain(ray.side, mul(ray.weight, answer.color))
        if dot(ray.direction, self.ahead) > 0.0:
            grown.missing += sum(ray.weight) / 3.0 * answer.none
        if not back:
            grown.ends.append(End(ray, answer, lost))


class _Part(NamedTuple):
    """Of a ray's weights."""

    weight: Vec
    clear: Vec

    def by(self, share: Vec) -> _Part:
        return _Part(mul(self.weight, share), mul(self.clear, share))

    def plus(self, other: _Part) -> _Part:
        return _Part(add(self.weight, other.weight), add(self.clear, other.clear))


class _Way(NamedTuple):
    """Through an interface, for one channel or for all."""

    channel: int
    mask: Vec
    ratio: float
    """index behind over index before"""
    split: Split


def _only(channel: int) -> Vec:
    return (float(channel == 0), float(channel == 1), float(channel == 2))


def _beside(ray: Ray, s: Surface) -> Ray:
    """It does not start on the surface, but a little to the side it goes to. What runs round in a ball doubles such a
    step at each reflection, so this is part of where it comes to."""
    step = math.copysign(_BESIDE[0] * max(abs(c) for c in s.point) + _BESIDE[1], dot(s.ng, ray.direction))
    return ray._replace(origin=add(s.point, scaled(s.ng, step)))


def _still_in(ray: Ray) -> Media:
    """What a ray is in that enters something. A model's inner stretch beyond the real body's wall has left the body."""
    if ray.inner is None or not ray.inner.beyond:
        return ray.media
    return tuple(m for m in ray.media if m is not ray.inner.body)


def _out(ray: Ray, inner: Inner) -> Ray:
    """From a typed model's exit, out of its body."""
    media = tuple(m for m in ray.media if m is not inner.body)
    passage = inner.passage
    return ray._replace(
        origin=passage.point, direction=passage.direction, start=0.0, begun=0.0, far=math.inf, media=media, inner=None,
        travelled=ray.travelled + passage.path,
    )  # fmt: skip


def _passage(model: Model, s: Surface, ior: float, thickness: float) -> Passage:
    if model is Model.SPHERE:
        return optics.through_sphere(s.point, s.ns, s.wo, ior, thickness)
    if model in (Model.BOX, Model.THIN):
        return optics.through_slab(s.point, s.ns, s.wo, ior, thickness)
    if model is Model.SINGLE:
        return optics.through_surface(s.point, s.ns, s.wo, ior)
    return Passage(0.0, s.point, scaled(s.wo, -1.0))


def _key(view: View, ray: Ray) -> sampling.Key:
    return view.key[0], view.key[1], ray.branch
