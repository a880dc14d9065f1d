"""Subdivision written down from the papers, one point at a time, with dictionaries: what the tests hold the reader to.

Catmull and Clark 1978, Loop 1987, and DeRose, Kass and Truong 1998 with OpenSubdiv's uniform sharpness, which an edge
loses by 1 each step; 10 stays for ever. A point whose last sharp edges smooth out in a step goes between where the rule
before and the rule after would put it, by the mean of what sharpness these edges had left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Vec = NDArray[np.float64]
Edge = frozenset[int]


@dataclass
class Net:
    """Points, polygons, and what is sharp."""

    points: list[Vec]
    faces: list[list[int]]
    sharp: dict[Edge, float] = field(default_factory=dict)
    pinned: dict[int, float] = field(default_factory=dict)

    def edges(self) -> dict[Edge, list[int]]:
        found: dict[Edge, list[int]] = {}
        for number, face in enumerate(self.faces):
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                found.setdefault(frozenset((a, b)), []).append(number)
        return found


def less(sharpness: float) -> float:
    return sharpness if sharpness >= 10 else max(sharpness - 1, 0)


def finer(net: Net, loop: bool = False) -> Net:
    """One step."""
    edges = net.edges()
    sharp = {edge: 10.0 if len(faces) != 2 else net.sharp.get(edge, 0.0) for edge, faces in edges.items()}
    later = {edge: less(value) for edge, value in sharp.items()}
    middles = [np.mean([net.points[i] for i in face], axis=0) for face in net.faces]
    points: list[Vec] = [at_point(net, i, edges, sharp, later, middles, loop) for i in range(len(net.points))]
    of_edge = {}
    for edge, faces in edges.items():
        a, b = sorted(edge)
        halfway = (net.points[a] + net.points[b]) / 2
        if loop and len(faces) == 2:
            apart = sum(net.points[i] for number in faces for i in net.faces[number] if i not in edge)
            smooth = 0.75 * halfway + 0.125 * apart
        elif len(faces) == 2:
            smooth = (net.points[a] + net.points[b] + middles[faces[0]] + middles[faces[1]]) / 4
        else:
            smooth = halfway
        share = min(sharp[edge], 1.0)
        of_edge[edge] = len(points)
        points.append((1 - share) * smooth + share * halfway)
    of_face = list(range(len(points), len(points) + len(net.faces)))
    if not loop:
        points += middles
    made = Net(points, [], {}, {i: less(value) for i, value in net.pinned.items()})
    for edge, at in of_edge.items():
        for end in edge:
            made.sharp[frozenset((end, at))] = later[edge]
    for number, face in enumerate(net.faces):
        ring = [of_edge[frozenset((a, b))] for a, b in zip(face, face[1:] + face[:1], strict=True)]
        for place, i in enumerate(face):
            if loop:
                made.faces.append([i, ring[place], ring[place - 1]])
            else:
                made.faces.append([i, ring[place], of_face[number], ring[place - 1]])
        if loop:
            made.faces.append(ring)
    return made


def at_point(
    net: Net,
    i: int,
    edges: dict[Edge, list[int]],
    sharp: dict[Edge, float],
    later: dict[Edge, float],
    middles: list[Vec],
    loop: bool,
) -> Vec:
    """Where an old point goes."""
    mine = [edge for edge in edges if i in edge]
    v = net.points[i]
    if not mine:
        return v
    around = [net.points[j] for edge in mine for j in edge - {i}]
    n = len(mine)
    if loop:
        beta = (5 / 8 - (3 / 8 + math.cos(2 * math.pi / n) / 4) ** 2) / n
        smooth = (1 - n * beta) * v + beta * sum(around)
    else:
        at_faces = [middles[number] for number, face in enumerate(net.faces) if i in face]
        halves = [(v + other) / 2 for other in around]
        smooth = (sum(at_faces) / len(at_faces) + 2 * sum(halves) / n + (n - 3) * v) / n

    def by(rule: dict[Edge, float], pinned: float) -> tuple[str, Vec]:
        creases = [edge for edge in mine if rule[edge] > 0]
        if pinned > 0 or len(creases) > 2:
            return "corner", v
        if len(creases) == 2:
            a, b = (net.points[j] for edge in creases for j in edge - {i})
            return "crease", (a + 6 * v + b) / 8
        return "smooth", smooth

    pinned = net.pinned.get(i, 0.0)
    (kind, now), (kind_later, then) = by(sharp, pinned), by(later, less(pinned))
    if kind == kind_later:
        return now
    going = [sharp[edge] for edge in mine if sharp[edge] > 0 and later[edge] <= 0]
    going += [pinned] if pinned > 0 and less(pinned) <= 0 else []
    share = min(sum(going) / len(going), 1.0)
    return share * now + (1 - share) * then


def after(net: Net, steps: int, loop: bool = False) -> Net:
    for _ in range(steps):
        net = finer(net, loop)
    return net
