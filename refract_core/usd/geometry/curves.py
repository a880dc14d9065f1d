"""BasisCurves and HermiteCurves read and checked, and made tubes or ribbons; how finely each is cut."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom

from ...scene import F32, F64, Notice
from .along import BASES, STRAIGHT, Along, Rule
from .cages import integers
from .moving import FLIGHT, points_at
from .primvars import LARGEST, Topology, Unusable, as_values
from .refined import Fineness
from .traverse import CURVES, FEW, Placement, some_of
from .triangulate import Index
from .tubes import Rings, Sides, directions, ribbons, tubes

ATTRIBUTES = ("points", "curveVertexCounts", "widths", "normals", "tangents", "type", "basis", "wrap", *FLIGHT)
WIDTH = 1.0
"""[units of the prim] of curves that say nothing of it, as Hydra has it."""
LIMIT = {2: 1_000_000, 3: 2_000_000, 4: 3_000_000, 5: 4_000_000}
"""Triangles of all curves of a stage, by `Fineness.steps`, up to which they are cut as finely as they should be."""
MOST = 4_000_000
"""Triangles of all curves of a stage; the plainest tubes may have as many whatever the complexity."""


class Cut(NamedTuple):
    """How finely curves are cut."""

    sides: int
    """of a tube"""
    pieces: float
    """segments of a cubic piece; a linear one needs no more than one. Under 1 some bends are left out"""
    least: int = 1
    """segments of a curve that has as many pieces, or a quarter of them cubic ones"""
    every: int = 1
    """Only one of so many curves is drawn, and as many times as wide."""


CUTS = (
    *(Cut(*pair) for pair in ((128, 64), (96, 48), (64, 32), (48, 24), (32, 16), (24, 12), (16, 8), (12, 6), (8, 5))),
    Cut(6, 4), Cut(5, 4), Cut(4, 4), Cut(4, 2, 8), Cut(3, 2, 8), Cut(3, 1, 5), Cut(3, 0.5, 5), Cut(3, 0.25, 3),
    Cut(3, 0.125, 2), Cut(3, 0.0625), Cut(3, 0.015625), Cut(3, 0.00390625),
)  # fmt: skip
"""From the finest to what a hair needs at least, and less."""
_WANTED = {2: Cut(24, 12), 3: Cut(32, 16), 4: Cut(48, 24), 5: Cut(64, 32)}
"""By `Fineness.steps`."""
_FEW = 8
"""Times `Fineness.few`: triangles of a prim under which it is as fine as may be; curves bend more than a face does."""
_HAIR = CUTS.index(Cut(3, 0.25, 3))


class Drawn(NamedTuple):
    """The curves of one prim."""

    sides: Sides
    topology: Topology
    round: bool
    """Tubes, not ribbons"""


def read_curves(
    prim: Usd.Prim, time: Usd.TimeCode, notices: list[Notice], fineness: Fineness, cut: Cut | None = None
) -> Drawn:
    """Curves as triangles; those that cannot be used are left out with a notice.

    Args:
        cut: how finely; None asks only what this prim has

    Raises:
        Unusable: nothing of it is left to draw.
    """
    if cut is None:
        cut = _cuts([_size(prim, time)], fineness)[0]
    rule = _rule(prim, time)
    points, controls, counts, kept = _usable(prim, time, rule, notices)
    along, rings = _rings(rule, controls, counts, kept[:: cut.every], cut)
    if not len(along.curves):
        raise Unusable("none of its curves has a length")
    widths = _widths(prim, time, along, len(points), notices) * cut.every
    if not (widths > 0.0).any():
        raise Unusable("its widths are all 0")
    facing = _facing(prim, time, along, len(points), notices)
    sides = tubes(rings, 0.5 * widths, cut.sides) if facing is None else ribbons(rings, widths, facing)
    topology = Topology(
        corners=sides.rings,
        vertices=sides.rings,
        faces=along.curves[along.ring_curve[sides.rings[:, 0]]],
        corner_count=along.varying_count,
        point_count=len(points),
        face_count=len(counts),
        refinement=along,
        varying_count=along.varying_count,
    )
    return Drawn(sides, topology, facing is None)


def cuts_for(
    placements: Sequence[Placement], time: Usd.TimeCode, fineness: Fineness, notices: list[Notice]
) -> dict[Sdf.Path, Cut]:
    """How finely the curves of a stage are cut, by prim. What is small is as fine as it should be; the rest share."""
    drawn: Counter[Sdf.Path] = Counter()
    for placement in placements:
        if placement.prim.GetTypeName() in CURVES:
            places = len(placement.worlds)
            drawn[placement.prim.GetPath()] += places if places < FEW else 1  # more share their triangles
    prims = {placement.prim.GetPath(): placement.prim for placement in placements}
    sizes = [_size(prims[path], time)._replace(times=times) for path, times in drawn.items()]
    cuts = _cuts(sizes, fineness)
    coarse: dict[Cut, list[str]] = {}
    for path, cut in zip(drawn, cuts, strict=True):
        if CUTS.index(cut._replace(every=1)) > CUTS.index(_WANTED[fineness.steps]):
            coarse.setdefault(cut, []).append(str(path))
    for cut, paths in coarse.items():
        what = f"{cut.sides} sides"
        if cut.pieces < 1.0:
            what += f" and one segment for {1.0 / cut.pieces:g} pieces, {cut.least} of a curve at least"
        what += f", and only one in {cut.every} of its curves, as many times as wide" if cut.every > 1 else ""
        text = f"its curves are drawn with {what}: all curves together may have {LIMIT[fineness.steps]:,} triangles"
        notices.append(Notice(paths[0], f"{text}, hair up to {MOST:,} ({some_of(paths)})"))
    return dict(zip(drawn, cuts, strict=True))


class _Size(NamedTuple):
    """What the number of a prim's triangles hangs on."""

    pieces: Index
    """shape (C,)"""
    cubic: bool
    periodic: bool
    flat: bool
    times: int = 1
    """that it is drawn"""

    def triangles(self, cut: Cut) -> int:
        """Of all of its curves, wherever they are drawn."""
        pieces = self.pieces[:: cut.every]
        segments = _segments(pieces, cut, cubic=self.cubic, periodic=self.periodic)
        a_segment, an_end = (2, 0) if self.flat else (2 * cut.sides, cut.sides - 2)
        ends = 0 if self.periodic else 2 * int((pieces > 0).sum())
        return self.times * (a_segment * int(segments.sum()) + an_end * ends)


def _size(prim: Usd.Prim, time: Usd.TimeCode) -> _Size:
    rule = _rule(prim, time)
    counts = integers(UsdGeom.Curves(prim).GetCurveVertexCountsAttr().Get(time))
    pieces = rule.pieces(counts.clip(0))
    return _Size(pieces, rule.basis != STRAIGHT, rule.periodic, _authored(prim, "normals", time) is not None)


def _segments(pieces: Index, cut: Cut, *, cubic: bool, periodic: bool) -> Index:
    """Segments of curves of so many pieces; a closed one has three at least."""
    few = np.minimum(cut.least, pieces * 4 if cubic else pieces)
    found = np.maximum(np.ceil(pieces * (cut.pieces if cubic else min(cut.pieces, 1.0))).astype(np.int64), few)
    return np.where(pieces > 0, np.maximum(found, 3 if periodic else 1), 0)


def _cuts(sizes: Sequence[_Size], fineness: Fineness) -> list[Cut]:
    """How finely each of several prims is cut, so that they stay below the limits together."""
    wanted = CUTS.index(_WANTED[fineness.steps])
    few = min(_FEW * fineness.few, LIMIT[fineness.steps] // max(len(sizes), 1))
    found = []
    shares = _shares([size.triangles(CUTS[wanted]) for size in sizes], LIMIT[fineness.steps])
    hairs = _shares([size.triangles(CUTS[_HAIR]) for size in sizes], MOST)
    for size, share, hair in zip(sizes, shares, hairs, strict=True):
        finer = [cut for cut in CUTS[:wanted] if size.triangles(cut) <= few]
        coarser = [cut for cut in CUTS[wanted : _HAIR + 1] if size.triangles(cut) <= share]
        hairy = [cut for cut in CUTS[_HAIR:] if size.triangles(cut) <= hair]
        fits = finer or coarser or hairy
        if fits:
            found.append(fits[0])
        else:
            plainest = CUTS[-1]
            found.append(plainest._replace(every=-(-size.triangles(plainest) // max(int(hair), 1))))
    return found


def _shares(asked: Sequence[int], limit: int) -> list[float]:
    """What each may have: all get what they ask for up to a level, at which their sum is the limit."""
    left, shares = float(limit), [0.0] * len(asked)
    order = sorted(range(len(asked)), key=asked.__getitem__)
    for done, row in enumerate(order):
        shares[row] = min(float(asked[row]), left / (len(order) - done))
        left -= shares[row]
    return shares


def _rule(prim: Usd.Prim, time: Usd.TimeCode) -> Rule:
    """As authored; `_checked` says whether there is such a kind."""
    if prim.GetTypeName() == "HermiteCurves":
        return Rule("hermite", str(UsdGeom.Tokens.nonperiodic))
    curves = UsdGeom.BasisCurves(prim)
    kind, basis = str(curves.GetTypeAttr().Get(time)), str(curves.GetBasisAttr().Get(time))
    return Rule(STRAIGHT if kind == UsdGeom.Tokens.linear else basis, str(curves.GetWrapAttr().Get(time)))


def _checked(rule: Rule) -> None:
    """Raises Unusable where a token is none of its schema's."""
    if rule.basis != "hermite" and rule.basis not in BASES:
        raise Unusable(f"its basis is '{rule.basis}'; it must be bezier, bspline or catmullRom")
    if rule.wrap not in (UsdGeom.Tokens.nonperiodic, UsdGeom.Tokens.periodic, UsdGeom.Tokens.pinned):
        raise Unusable(f"its wrap is '{rule.wrap}'; it must be nonperiodic, periodic or pinned")


def _usable(
    prim: Usd.Prim, time: Usd.TimeCode, rule: Rule, notices: list[Notice]
) -> tuple[F64, F64, Index, Index]:
    """Points, what the basis is applied to, points of every curve, and the numbers of the curves to draw.

    Raises:
        Unusable: there are none.
    """
    _checked(rule)
    curves = UsdGeom.Curves(prim)
    values, counts = as_values(points_at(prim, time)), integers(curves.GetCurveVertexCountsAttr().Get(time))
    if values is None or not len(values) or values.shape[1] != 3:
        raise Unusable("it has no points at this time")
    if not len(counts):
        raise Unusable("it has no curveVertexCounts at this time")
    if counts.min() < 0:
        raise Unusable(f"curveVertexCounts has {int((counts < 0).sum())} negative values")
    points = values.astype(np.float64)
    controls = points if rule.basis != "hermite" else _hermite(prim, time, points)
    wild = ~(np.abs(controls) <= LARGEST).all(axis=1).reshape(-1, len(points)).all(axis=0)
    bad = np.concatenate(([0], np.cumsum(wild)))
    ends = np.cumsum(counts)
    here = np.minimum(ends, len(points))
    good = np.ones(len(counts), bool)
    faults: dict[str, int] = {}
    for fits, why in (
        (rule.pieces(counts) > 0, f"curves whose curveVertexCounts is not {rule.needs}"),
        (ends <= len(points), f"curves whose curveVertexCounts go beyond the {len(points)} points"),
        (bad[here] == bad[np.minimum(ends - counts, len(points))], "curves with points that are NaN or over 1e15"),
    ):
        if lost := int((good & ~fits).sum()):
            faults[why] = lost
        good &= fits
    if ends[-1] < len(points):
        faults["points that belong to no curve"] = int(len(points) - ends[-1])
    listed = ", ".join(f"{count} {why}" for why, count in faults.items())
    if not good.any():
        raise Unusable(f"none of its {len(counts)} curves can be drawn: {listed}")
    if faults:
        text = f"not everything in its {len(counts)} curves can be used; left out: {listed}"
        notices.append(Notice(str(prim.GetPath()), text))
    return points, controls, counts, np.flatnonzero(good)


def _hermite(prim: Usd.Prim, time: Usd.TimeCode, points: F64) -> F64:
    """The Bezier controls of Hermite curves: points, those after them and those before them, shape (3 P, 3).

    Raises:
        Unusable: there are not as many tangents as points.
    """
    tangents = as_values(UsdGeom.HermiteCurves(prim).GetTangentsAttr().Get(time))
    if tangents is None or tangents.shape != points.shape:
        count = 0 if tangents is None else len(tangents)
        raise Unusable(f"it has {len(points)} points, but {count} tangents")
    third = tangents.astype(np.float64) / 3.0
    return np.concatenate((points, points + third, points - third))


def _rings(rule: Rule, controls: F64, counts: Index, kept: Index, cut: Cut) -> tuple[Along, Rings]:
    """Places evenly along the curves; curves without a length are left out."""
    pieces = rule.pieces(counts)[kept]
    segments = _segments(pieces, cut, cubic=rule.basis != STRAIGHT, periodic=rule.periodic)
    ring_counts = segments + (0 if rule.periodic else 1)
    owner = np.repeat(np.arange(len(kept)), ring_counts)
    step = (np.arange(len(owner)) - np.repeat(np.cumsum(ring_counts) - ring_counts, ring_counts)) * pieces[owner]
    piece = np.minimum(step // segments[owner], pieces[owner] - 1)
    u = (step - piece * segments[owner]) / segments[owner]
    along = Along(rule, kept, counts, owner, piece, u)
    centres = along.evaluated(controls, piece, u)
    apart = _apart(centres, owner, ring_counts, periodic=rule.periodic)
    left = np.bincount(owner[apart], minlength=len(kept))
    long = left >= (3 if rule.periodic else 2)
    if not (long.all() and apart.all()):
        keep = apart & long[owner]
        owner = (np.cumsum(long) - 1)[owner[keep]]
        along = Along(rule, kept[long], counts, owner, piece[keep], u[keep])
        centres = centres[keep]
    return along, _directed(along, controls, centres, left[long])


def _apart(centres: F64, owner: Index, counts: Index, *, periodic: bool) -> NDArray[np.bool_]:
    """Rings that are not where the one before them on their curve is."""
    least = 1e-12 * float(np.abs(centres).max())
    before = np.arange(len(centres)) - 1
    starts = np.cumsum(counts) - counts
    before[starts] = starts + counts - 1 if periodic else starts
    moved: NDArray[np.bool_] = np.abs(centres - centres[before]).max(axis=1) > least
    if not periodic:
        moved[starts] = True
    return moved


def _directed(along: Along, controls: F64, centres: F64, counts: Index) -> Rings:
    """Rings with the directions in which the curves come to them and leave them."""
    rule, starts = along.rule, np.cumsum(counts) - counts
    rings = Rings(centres, centres, centres, starts, counts, rule.periodic)
    if not len(counts):
        return rings
    first, last = rings.segments
    chord = centres[last] - centres[first]
    leaving, coming = np.zeros_like(centres), np.zeros_like(centres)
    leaving[first], coming[last] = chord, chord
    if not rule.periodic:
        leaving[starts + counts - 1] = coming[starts + counts - 1]
        coming[starts] = leaving[starts]
    if rule.basis == STRAIGHT:
        return rings._replace(before=directions(coming, leaving), after=directions(leaving, coming))
    slope = along.evaluated(controls, along.piece, along.u, derivative=True)
    after = directions(slope, leaving)
    before = directions(slope, coming)
    if rule.basis in ("bezier", "hermite"):  # the others have no corners between their pieces
        begins = along.u == 0.0
        if not rule.periodic:
            begins[starts] = False
        of_curve = along.pieces[along.curves[along.ring_curve]]
        piece = np.where(begins, (along.piece - 1) % of_curve, along.piece)
        slope = along.evaluated(controls, piece, np.where(begins, 1.0, along.u), derivative=True)
        before = directions(slope, coming)
    return rings._replace(before=before, after=after)


def _authored(prim: Usd.Prim, name: str, time: Usd.TimeCode) -> tuple[F32, str] | None:
    """`primvars:name`, else the attribute itself, and its interpolation; None where there are no values."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
    if primvar and primvar.HasValue():
        values, kind = as_values(primvar.ComputeFlattened(time)), primvar.GetInterpolation()
    else:
        values = as_values(prim.GetAttribute(name).Get(time))
        curves = UsdGeom.Curves(prim)
        kind = curves.GetWidthsInterpolation() if name == "widths" else curves.GetNormalsInterpolation()
    return None if values is None or not len(values) else (values, str(kind))


def _on_curves(values: F32, kind: str, along: Along, points: int) -> F64:
    """Values of an interpolation at every ring.

    Raises:
        Unusable: there are not as many as the interpolation takes.
    """
    sizes = {
        "constant": 1, "uniform": len(along.counts), "vertex": points, "varying": along.varying_count,
        "faceVarying": along.varying_count,
    }  # fmt: skip
    if kind not in sizes:
        raise Unusable(f"its interpolation '{kind}' is not one of {', '.join(sizes)}")
    if len(values) != sizes[kind]:
        raise Unusable(f"it is {kind}, which takes {sizes[kind]} values here, but has {len(values)}")
    return along.at_rings(values.astype(np.float64), kind)


def _widths(prim: Usd.Prim, time: Usd.TimeCode, along: Along, points: int, notices: list[Notice]) -> F64:
    """Width at every ring, shape (N,), >= 0."""
    path = str(prim.GetPath())
    authored = _authored(prim, "widths", time)
    if authored is None:
        notices.append(Notice(path, f"its curves have no widths; {WIDTH:g} scene unit is used, as usdview does"))
        return np.full(len(along.u), WIDTH)
    values, kind = authored
    good: NDArray[np.bool_] = np.logical_and(values >= 0.0, values <= LARGEST)
    if lost := int((~good).sum()):
        text = f"widths has {lost} values that are negative, NaN or infinite; 0 is used in their place"
        notices.append(Notice(path, text))
    if len(values) == 1:
        kind = str(UsdGeom.Tokens.constant)
    try:
        found = _on_curves(np.where(good, values, np.float32(0.0))[:, :1], kind, along, points)
    except Unusable as reason:
        notices.append(Notice(path, f"widths is ignored, and {WIDTH:g} scene unit used: {reason}"))
        return np.full(len(along.u), WIDTH)
    return np.maximum(found[:, 0], 0.0)


def _facing(prim: Usd.Prim, time: Usd.TimeCode, along: Along, points: int, notices: list[Notice]) -> F64 | None:
    """Where ribbons face at every ring, shape (N, 3); None for tubes."""
    authored = _authored(prim, "normals", time)
    if authored is None:
        return None
    values, kind = authored
    try:
        if values.shape[1] != 3:
            raise Unusable("they are not vectors of 3")
        found = _on_curves(np.where(np.isfinite(values), values, np.float32(0.0)), kind, along, points)
    except Unusable as reason:
        notices.append(Notice(str(prim.GetPath()), f"normals is ignored, and round tubes drawn: {reason}"))
        return None
    return np.array(found)
