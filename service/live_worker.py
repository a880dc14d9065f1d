"""What a live worker does once it is confined: it holds one stage, made ready, and draws a small picture per order.

Orders come as lines on the socket that its job came by, one at a time; a picture lies in the job's folder when its
order is answered. It draws no stage but its own, and an order that cannot be done is its end.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, BinaryIO

from refract_core.scene import Scene

from . import reading, tasks
from .tasks import Say

PICTURE = "frame.png"


def verb(orders: BinaryIO) -> tasks.Verb:
    """Drawing by the orders of a file, as a job: for `tasks.perform`."""

    def draw(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Say) -> Any:
        from refract_core.rendering.picture import render
        from refract_core.rendering.session import Session
        from refract_core.usd.opening import select_variants
        from refract_core.usd.settings import read_settings
        from refract_core.usd.stage import open_stage, scene_from_stage
        from refract_core.verbs.render_files import chosen_settings

        opened = open_stage(stage)
        select_variants(opened, settings.get("variants") or ())
        authored = read_settings(opened, "", [])
        session = Session()
        held: tuple[Any, Scene] | None = None
        for line in iter(orders.readline, b""):
            order = json.loads(line)
            wanted = chosen_settings(authored, {**tasks.asked_of(order), "jobs": settings["threads"]})
            key = order.get("time_code"), wanted.purposes, wanted.camera, wanted.longer_side
            if held is None or held[0] != key:
                if held is not None:
                    reading.begins(limits["stage_seconds"])
                scene = scene_from_stage(
                    opened, time_code=key[0], purposes=wanted.purposes, camera=wanted.camera, pixels=wanted.longer_side
                )
                reading.has_ended()
                tasks.check_scene(scene, limits)
                held = key, scene
            frame = render(tasks.overridden(held[1], order.get("overrides") or {}), wanted, session=session)
            path = os.path.join(out, PICTURE)
            replace(frame, metadata={}).save(f"{path}.png", aovs=(), color_correction="sRGB")
            os.replace(f"{path}.png", path)
            say(frame=True)
        return {}

    return draw
