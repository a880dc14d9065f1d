"""The pieces that points of curves make by their type, basis and wrap, and values of every interpolation along them.

Source of the rules: OpenUSD's schema of UsdGeomBasisCurves (segments, phantom points, sizes of primvars).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from pxr import UsdGeom

from ...scene import F32, F64
from .triangulate import Index

# Rows are powers of u from 0 on, columns the four values of a piece.
BASES = {
    "linear": np.array([[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]], np.float64),
    "bezier": np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64),
    "bspline": np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6.0,
    "catmullRom": np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]], np.float64) / 2.0,
}
STRAIGHT = "linear"


class Rule(NamedTuple):
    """What kind of curves a prim has."""

    basis: str
    """a name in `BASES`, or hermite"""
    wrap: str

    @property
    def periodic(self) -> bool:
        return self.wrap == UsdGeom.Tokens.periodic

    @property
    def phantoms(self) -> bool:
        """One more point before the first and after the last, which nobody authors."""
        return self.wrap == UsdGeom.Tokens.pinned and self.basis in ("bspline", "catmullRom")

    def pieces(self, counts: Index) -> Index:
        """Pieces of curves of so many points; 0 where a curve cannot have so many."""
        if self.basis in (STRAIGHT, "hermite"):
            return np.where(counts >= 3, counts, 0) if self.periodic else np.maximum(counts - 1, 0)
        if self.basis == "bezier":
            if self.periodic:
                return np.where(counts % 3 == 0, counts // 3, 0)
            return np.where((counts >= 4) & ((counts - 4) % 3 == 0), (counts - 4) // 3 + 1, 0)
        if self.periodic:
            return np.where(counts >= 3, counts, 0)
        return np.maximum(counts - 1 if self.phantoms else counts - 3, 0)

    @property
    def needs(self) -> str:
        """In words, what a count must be."""
        if self.basis in (STRAIGHT, "hermite"):
            return "3 or more" if self.periodic else "2 or more"
        if self.basis == "bezier":
            return "a multiple of 3" if self.periodic else "4, 7, 10 ..."
        return "3 or more" if self.periodic else ("2 or more" if self.phantoms else "4 or more")


@dataclass(frozen=True)
class Along:
    """Where the rings of a prim's curves are, and what values of every interpolation are there."""

    rule: Rule
    curves: Index
    """shape (C,): the curves that are drawn, by their number in the prim"""
    counts: Index
    """shape (A,): points of every curve of the prim, drawn or not"""
    ring_curve: Index
    """shape (N,): place in `curves`"""
    piece: Index
    """shape (N,): number of the piece in its curve"""
    u: F64
    """shape (N,): place in the piece, 0 .. 1"""

    @cached_property
    def pieces(self) -> Index:
        """shape (A,)"""
        return self.rule.pieces(self.counts)

    @cached_property
    def starts(self) -> Index:
        """shape (A,): first point of every curve"""
        return np.cumsum(self.counts) - self.counts

    @property
    def varying_count(self) -> int:
        return int(self._varying_counts.sum())

    @property
    def _varying_counts(self) -> Index:
        return self.pieces + (0 if self.rule.periodic else 1)

    def at_rings(self, values: F64, interpolation: str) -> F64:
        """Values (K, D) of an interpolation at every ring, shape (N, D)."""
        if interpolation == UsdGeom.Tokens.constant:
            return np.broadcast_to(values[:1], (len(self.u), values.shape[1]))
        number = self.curves[self.ring_curve]
        if interpolation == UsdGeom.Tokens.uniform:
            return values[number]
        if interpolation == UsdGeom.Tokens.vertex and self.rule.basis != "hermite":
            return self.evaluated(values, self.piece, self.u)
        if interpolation == UsdGeom.Tokens.vertex:
            starts, around = self.starts[number], self.counts[number]
        else:
            every = self._varying_counts
            starts, around = (np.cumsum(every) - every)[number], every[number]
        following = (self.piece + 1) % around
        share = self.u[:, None]
        return (1.0 - share) * values[starts + self.piece] + share * values[starts + following]

    def corners(self, values: F32, interpolation: str) -> tuple[F32, Index]:
        """As `Refinement.corners`: values at every ring, and which of them each ring takes."""
        found = self.at_rings(values.astype(np.float64), interpolation)
        return np.ascontiguousarray(found, np.float32), np.arange(len(self.u))

    def evaluated(self, values: F64, piece: Index, u: F64, *, derivative: bool = False) -> F64:
        """Values (P, D) of the points, by the basis, somewhere on every ring's own curve; or how they change with u."""
        one = np.ones_like(u)
        power = (0.0 * u, one, 2.0 * u, 3.0 * u * u) if derivative else (one, u, u * u, u * u * u)
        weights = np.stack(power, axis=1) @ BASES["bezier" if self.rule.basis == "hermite" else self.rule.basis]
        values, columns = self._columns(values, piece)
        found: F64 = weights[:, :1] * values[columns[0]]
        for k in range(1, len(columns)):
            found += weights[:, k : k + 1] * values[columns[k]]
        return found

    def _columns(self, values: F64, piece: Index) -> tuple[F64, list[Index]]:
        """Values with what nobody authors behind them, and the rows of each piece's two or four."""
        number = self.curves[self.ring_curve]
        start, count = self.starts[number], self.counts[number]
        if self.rule.basis == "hermite":  # controls: the points, those after them and those before them
            third = len(values) // 3
            following = start + (piece + 1) % count
            return values, [start + piece, third + start + piece, 2 * third + following, following]
        if self.rule.phantoms:
            first = self.starts[self.curves]
            last = first + self.counts[self.curves] - 1
            before = 2.0 * values[first] - values[first + 1]
            behind = 2.0 * values[last] - values[last - 1]
            rows = [start + piece + k for k in (-1, 0, 1, 2)]
            rows[0] = np.where(piece == 0, len(values) + self.ring_curve, rows[0])
            rows[3] = np.where(piece == count - 2, len(values) + len(first) + self.ring_curve, rows[3])
            return np.concatenate((values, before, behind)), rows
        step = 3 if self.rule.basis == "bezier" else 1
        width = 2 if self.rule.basis == STRAIGHT else 4
        return values, [start + (step * piece + k) % count for k in range(width)]
