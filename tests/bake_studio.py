"""A stage with probes on disk and a fake engine, for the tests of baking."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from refract_core.progress import Report
from refract_core.scene import CUBE_LEVELS, Cubemap, Probe, Scene
from refract_core.usd.stage import load_stage
from refract_core.verbs.bake_probes import BakeOrder, bake_probes

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    startTimeCode = 7
    timeCodesPerSecond = 10
    upAxis = "Y"
)
def Xform "World"
{
    def Cube "Box"
    {
        color3f[] primvars:displayColor = [(0.8, 0.1, 0.1)]
        double3 xformOp:translate = (3, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def RefractProbe "Left"
    {
        uniform int probe:resolution = 64
    }
    def RefractProbe "Right"
    {
        uniform int probe:resolution = 32
        double3 xformOp:translate = (0, 1, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def RefractProbe "Live"
    {
        uniform token probe:mode = "realtime"
    }
    def RefractProbe "Given"
    {
        uniform token probe:mode = "custom"
    }
    def RefractPlanarProbe "Mirror"
    {
    }
}
"""
LEFT, RIGHT = "/World/Left", "/World/Right"


@dataclass
class Studio:
    """A stage on disk, a fake engine, and everything that was said."""

    folder: Path
    captured: list[str] = field(default_factory=list)
    said: dict[str, str] = field(default_factory=dict)
    warned: dict[str, str] = field(default_factory=dict)
    fractions: list[float] = field(default_factory=list)
    before: Callable[[], None] = lambda: None
    cancelled: bool = False

    @property
    def stage(self) -> Path:
        return self.folder / "stage.usda"

    def out(self, extension: str = ".usda") -> Path:
        return self.folder / f"out{extension}"

    def texture(self, path: str) -> Path:
        return self.folder / "out.probes" / f"{path.strip('/').replace('/', '_')}.exr"

    def capture(self, scene: Scene, probes: Sequence[Probe], *, samples: int, jobs: int, **calls: Any) -> list[Cubemap]:
        """Grey, as bright as the number of samples says; distance is the time."""
        self.before()
        calls["progress"](0.5, "probes")
        self.captured += [probe.path for probe in probes]
        return [Cubemap(tuple(grey(p.resolution >> m, samples, scene) for m in range(CUBE_LEVELS))) for p in probes]

    def report(self) -> Report:
        self.said.clear()
        self.warned.clear()
        progress: Callable[[float, str], None] = lambda fraction, _text: self.fractions.append(fraction)  # noqa: E731
        return Report(progress, self.warned.__setitem__, self.said.__setitem__, lambda _text: None)

    def bake(self, extension: str = ".usda", **fields: Any) -> Usd.Stage:
        self.captured.clear()
        order = BakeOrder(stage=str(self.stage), out=str(self.out(extension)), **fields)
        bake_probes(order, self.report(), lambda: self.cancelled, capture=self.capture)
        return Usd.Stage.Open(str(self.out(extension)))

    def change(self) -> None:
        """Move the box that both probes see."""
        self.stage.write_text(self.stage.read_text().replace("(3, 0, 0)", "(3, 0, 1)"))
        os.utime(self.stage, ns=(1, int(1e18) + len(self.captured)))


def grey(side: int, samples: int, scene: Scene) -> Any:
    texels = np.ones((6, max(1, side), max(1, side), 5), np.float32)
    texels[..., :3] = samples / 16
    texels[..., 4] = scene.time_code
    return texels


def studio_in(folder: Path) -> Studio:
    (folder / "stage.usda").write_text(STAGE)
    return Studio(folder)


def probe_of(path: Path, name: str) -> Probe:
    return next(probe for probe in load_stage(path).probes if probe.path == name)
