"""What a comparison of two pictures finds: records, and how they are computed from two sets of planes.

Counted are all pixels, those of glass (`mask` of at least one half), those that show the glass of a prim first, and
those of glass that one tier answered for (its `weight.*` above one half).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..scene import F32, F64
from ..settings import TIERS
from .compare import displayed, flip_lacks, flip_map, psnr, ssim_map

Planes = Mapping[str, F32]
"""AOV name (`aovs.AOVS`) -> float32, as `Frame.planes`."""
Mask = NDArray[np.bool_]

COVERED = 0.5
"""`mask` from which a pixel counts as glass; a tier's weight over which its pixel counts as that tier's."""
BETTER = 0.1
"""[dB] by which another model must come nearer before a stage is worth changing."""
WEIGHTS = tuple(f"weight.{tier}" for tier in (*TIERS, "none"))


@dataclass(frozen=True)
class Score:
    """How far apart two pictures are, over some pixels."""

    pixels: int
    psnr: float
    """[dB]; infinite where nothing differs"""
    ssim: float
    flip: float | None
    """0 looks the same, 1 could not look more different; None where FLIP cannot be computed"""


@dataclass(frozen=True)
class Part:
    """Pixels that belong together, and their score."""

    name: str
    """Path of a prim, or a tier."""
    score: Score | None
    """None where no pixel shows it."""
    materials: tuple[str, ...] = ()
    """Of a prim: its glass."""


@dataclass(frozen=True)
class Correlation:
    """How the confidence AOV goes with the true error, over the glass. -1: the less sure, the further off."""

    pixels: int
    pearson: float | None
    """None where one of the two is the same everywhere."""
    spearman: float | None
    """Of the ranks: 1 and -1 for any monotone relation (Spearman 1904)."""


@dataclass(frozen=True)
class Findings:
    """Numbers of two pictures."""

    whole: Score
    glass: Score | None
    """None where nothing says that there is glass."""
    objects: tuple[Part, ...]
    tiers: tuple[Part, ...]
    confidence: Correlation | None
    lacks: tuple[str, ...]
    """What was left out, and why."""

    @property
    def counted(self) -> Score:
        """What `--fail-under` looks at: the glass, or everything where there is none."""
        return self.glass or self.whole


@dataclass(frozen=True)
class Trial:
    """One model with one thickness, on everything that a material is on."""

    model: str
    thickness: str
    """authored: as the stage has it; fitted: one number by the shape; measured: what rays find; '' where none is
    needed"""
    value: float | None
    """[stage units]: the fitted number"""
    psnr: float
    """[dB] over the material's pixels"""
    objects: Mapping[str, float]
    """Path of a prim -> PSNR [dB] of its pixels."""
    now: bool
    """As the stage has it."""

    @property
    def label(self) -> str:
        return f"{self.model} {self.thickness}".strip()


@dataclass(frozen=True)
class Trials:
    """What was tried on one material."""

    material: str
    trials: tuple[Trial, ...]
    notes: tuple[str, ...]
    """What a person should know."""

    @property
    def best(self) -> Trial:
        """The one nearest to the reference; what the stage has where nothing is better by `BETTER`."""
        found = max(self.trials, key=lambda trial: trial.psnr)
        return found if found.psnr >= self.now.psnr + BETTER else self.now

    @property
    def now(self) -> Trial:
        return next(trial for trial in self.trials if trial.now)


@dataclass(frozen=True)
class Written:
    """The layer of `--write`."""

    file: str
    changed: tuple[str, ...]
    """Materials that it changes."""
    score: Score
    """Of the glass, or of everything where there is none, drawn as the layer has it."""


class Contrast:
    """Two pictures of one size as they are shown, and the maps of what differs, each made once."""

    def __init__(self, picture: Planes, reference: Planes, names: tuple[str, str] = ("the picture", "the reference")):
        """Args:
            picture: planes with `beauty`, scene-linear and premultiplied; seen over black.
            reference: the same.
            names: what messages call them.

        Raises:
            UsageError: the sizes differ, or a picture holds values that are no numbers.
        """
        sizes = [planes["beauty"].shape[:2] for planes in (picture, reference)]
        if sizes[0] != sizes[1]:
            first, second = (f"{width} x {height} pixels" for height, width in sizes)
            raise UsageError(
                f"{names[0]} has {first} and {names[1]} {second}; only pictures of one size can be compared, so render "
                "one of them again"
            )
        for name, planes in zip(names, (picture, reference), strict=True):
            if bad := int(np.isnan(planes["beauty"][..., :3]).any(axis=2).sum()):
                raise UsageError(f"{name} holds NaN in {bad} pixels, so no number would mean anything; render it again")
        self.test, self.truth = (displayed(planes["beauty"][..., :3]) for planes in (picture, reference))
        self.ssim: F64 = ssim_map(self.test, self.truth)
        self.lacks = flip_lacks()
        self.flip: F32 | None = None if self.lacks else flip_map(self.test, self.truth)

    def score(self, mask: Mask) -> Score | None:
        """The score over some pixels; None where there are none."""
        if not mask.any():
            return None
        flip = None if self.flip is None else float(np.mean(self.flip[mask], dtype=np.float64))
        return Score(int(mask.sum()), psnr(self.test, self.truth, mask), float(np.mean(self.ssim[mask])), flip)

    @property
    def everywhere(self) -> Mask:
        return np.ones(self.test.shape[:2], np.bool_)

    @property
    def error(self) -> F64:
        """Root mean square of the channels' differences, as shown; shape (H, W)."""
        difference = self.test.astype(np.float64) - self.truth
        found: F64 = np.sqrt(np.mean(difference * difference, axis=2))
        return found


def find(contrast: Contrast, planes: Planes, objects: Mapping[str, tuple[Mask, tuple[str, ...]]]) -> Findings:
    """Every number of a comparison.

    Args:
        planes: of the picture; what is there of `mask`, `weight.*` and `confidence` is used.
        objects: path of a prim -> its pixels and the names of its glass.
    """
    glass = glass_of(planes)
    lacks = [contrast.lacks] if contrast.lacks else []
    weights = {name: planes[name] for name in WEIGHTS if name in planes}
    inside = contrast.everywhere if glass is None else glass
    tiers = [Part(name.removeprefix("weight."), contrast.score(inside & (w > COVERED))) for name, w in weights.items()]
    confidence = planes.get("confidence")
    known = confidence is not None and glass is not None and glass.any()
    whole = contrast.score(contrast.everywhere)
    assert whole is not None
    return Findings(
        whole=whole,
        glass=None if glass is None else contrast.score(glass),
        objects=tuple(Part(path, contrast.score(mask), names) for path, (mask, names) in objects.items()),
        tiers=tuple(part for part in tiers if part.score),
        confidence=correlation(confidence[glass], contrast.error[glass]) if known else None,  # type: ignore[index]
        lacks=tuple(lacks),
    )


def glass_of(planes: Planes) -> Mask | None:
    """Pixels that show glass, shape (H, W); None where the planes do not say."""
    return planes["mask"] >= COVERED if "mask" in planes else None


def correlation(confidence: F32, error: F64) -> Correlation:
    """How two columns of numbers go together.

    Args:
        confidence: shape (N,), N > 0.
        error: shape (N,).
    """
    pair = confidence.astype(np.float64), error.astype(np.float64)
    ranks = _ranks(pair[0]), _ranks(pair[1])
    return Correlation(len(error), _pearson(*pair), _pearson(*ranks))


def _pearson(x: F64, y: F64) -> float | None:
    x, y = x - x.mean(), y - y.mean()
    power = math.sqrt(float(x @ x) * float(y @ y))
    # What is left of two equal columns is rounding.
    return None if np.ptp(x) == 0.0 or np.ptp(y) == 0.0 or power == 0.0 else float(x @ y) / power


def _ranks(values: F64) -> F64:
    """Places in ascending order; equal values share the mean of theirs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks: F64 = (last - (counts - 1) / 2.0)[which]
    return ranks
