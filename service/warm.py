"""What workers do before they are given a stranger's stage: read and draw one of our own that needs all there is.

`warm_stage/` makes USD load its plug-ins and schemas, and touches every kernel.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

STAGE = Path(__file__).parent / "warm_stage" / "stage.usda"


def draw(screens: tuple[str, ...] = ("traced", "proxy")) -> None:
    """Load all that a job may need. About a minute where kernels are to be compiled, two seconds later.

    In a process that has just been forked it takes a tenth of a second, and gives it memory of its own: a job that
    must first copy what it shared with its parent, page by page, is 50 ms slower.

    Args:
        screens: methods of the screen tier to draw with, one after the other.
    """
    from refract_core.rendering.picture import render
    from refract_core.settings import RenderSettings
    from refract_core.usd.stage import load_stage

    from .precheck import check_stage

    check_stage(str(STAGE), str(STAGE.parent), layers=1, unpacked_bytes=1)
    scene = load_stage(STAGE)
    for screen in screens:
        wanted = RenderSettings(
            image_width=16, image_height=16, samples=1, screen=screen, tiers=("screen", "ray", "probe", "sky"), jobs=1
        )
        frame = render(scene, wanted)
    with tempfile.TemporaryDirectory() as folder:  # the library of pictures too
        frame.save(os.path.join(folder, "warm.png"))
