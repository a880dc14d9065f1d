"""The page in Firefox, against tests/fake_service.py, by WebDriver BiDi, which it speaks itself. Skipped where it is
not installed. What the page does is tested with Chromium (`test_page_browser`); here it works in another engine."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import shutil
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from fake_service import FakeService

websocket = pytest.importorskip("tornado.websocket")
FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
if FIREFOX is None:
    pytest.skip("Firefox is not installed", allow_module_level=True)

pytestmark = pytest.mark.slow
PATIENCE = 60.0
"""[s] Longest wait for what has to happen, on a machine whose cores are busy with other things."""
LISTENING = re.compile(rb"WebDriver BiDi listening on (ws://\S+)")
STATUS = "document.getElementById('status').textContent"
MIDDLE = "String([...document.getElementById('canvas-a').getContext('2d').getImageData(32, 18, 1, 1).data])"


class Window(NamedTuple):
    """A window of a Firefox that is told what to do."""

    socket: Any
    context: str
    numbers: Any
    """of commands"""
    wrong: list[str]
    """errors that its console has shown"""


async def tell(window: Window, method: str, **words: Any) -> Any:
    """Send a command, and wait for its answer; what is logged meanwhile is noted."""
    number = next(window.numbers)
    await window.socket.write_message(json.dumps({"id": number, "method": method, "params": words}))
    while True:
        text = await asyncio.wait_for(window.socket.read_message(), PATIENCE)
        assert text is not None, "Firefox has gone"
        message = json.loads(text)
        if message.get("method") == "log.entryAdded" and message["params"]["level"] == "error":
            window.wrong.append(str(message["params"].get("text")))
        if message.get("id") == number:
            assert message["type"] == "success", message
            return message["result"]


async def value(window: Window, expression: str) -> Any:
    """What an expression is on the page."""
    found = await tell(
        window, "script.evaluate", expression=expression, target={"context": window.context}, awaitPromise=True
    )
    assert found["type"] == "success", found
    return found["result"].get("value")


async def until(window: Window, expression: str) -> None:
    """Wait for something to be true on the page."""
    end = time.monotonic() + PATIENCE
    while not await value(window, expression):
        assert time.monotonic() < end, f"waited too long for {expression}; {await value(window, STATUS)}"
        await asyncio.sleep(0.05)


@asynccontextmanager
async def opened(url: str, profile: Path) -> AsyncIterator[Window]:
    """A window of a new Firefox at an address. An error in its console fails the test."""
    command = [str(FIREFOX), "--headless", "--no-remote", "--remote-debugging-port=0", "--profile", str(profile)]
    started = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
    )
    assert started.stderr is not None
    try:
        address = b""
        while not address:
            line = await asyncio.wait_for(started.stderr.readline(), PATIENCE)
            assert line, "Firefox has ended"
            if found := LISTENING.search(line):
                address = found[1]
        drain = asyncio.create_task(started.stderr.read())
        socket = await websocket.websocket_connect(address.decode() + "/session")
        window = Window(socket, "", itertools.count(), [])
        await tell(window, "session.new", capabilities={})
        await tell(window, "session.subscribe", events=["log.entryAdded"])
        tree = await tell(window, "browsingContext.getTree")
        window = window._replace(context=tree["contexts"][0]["context"])
        here = {"context": window.context}
        await tell(window, "browsingContext.setViewport", **here, viewport={"width": 1200, "height": 900})
        await tell(window, "browsingContext.navigate", **here, url=url, wait="complete")
        yield window
        assert [line for line in window.wrong if "Failed to load resource" not in line] == []
        socket.close()
        drain.cancel()
    finally:
        if started.returncode is None:
            started.kill()
        await started.wait()


async def drag(window: Window, right: int) -> None:
    """Drag the picture by so many pixels."""
    box = json.loads(await value(window, "JSON.stringify(document.getElementById('canvas-a').getBoundingClientRect())"))
    x, y = round(box["x"] + box["width"] / 2), round(box["y"] + box["height"] / 2)
    steps = [{"type": "pointerMove", "x": x, "y": y}, {"type": "pointerDown", "button": 0}]
    steps += [{"type": "pointerMove", "x": x + right * k // 4, "y": y, "duration": 30} for k in range(1, 5)]
    steps.append({"type": "pointerUp", "button": 0})
    await tell(window, "input.performActions", context=window.context,
               actions=[{"type": "pointer", "id": "mouse", "actions": steps}])  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="it is started as on Linux")
def test_a_sample_is_drawn_turned_and_made_of_another_glass(tmp_path: Path) -> None:
    async def use(service: FakeService) -> None:
        async with opened(service.url, tmp_path) as window:
            ball = "[...document.querySelectorAll('button')].find(button => button.textContent.trim() === 'ball')"
            await until(window, f"!!{ball}")
            await value(window, f"{ball}.click()")
            await until(window, f"{STATUS} === 'Done in 1.9 s.' && document.getElementById('canvas-a').offsetWidth > 0")
            before = await value(window, MIDDLE)
            await drag(window, 80)
            await until(window, f"{MIDDLE} !== '{before}'")
            await until(window, f"{STATUS} === 'Done in 1.9 s.'")
            assert abs(service.asked("POST", "/v1/render")[-1]["azimuth"]) > 5.0
            slider = "document.querySelector('[aria-label=\"Ball: Index of refraction, slider\"]')"
            await value(window, f"{slider}.value = 1.7, {slider}.dispatchEvent(new Event('input', {{bubbles: true}})), "
                                f"{slider}.dispatchEvent(new Event('change', {{bubbles: true}})), 0")  # fmt: skip
            end = time.monotonic() + PATIENCE
            while "overrides" not in service.asked("POST", "/v1/render")[-1]:
                assert time.monotonic() < end
                await asyncio.sleep(0.05)
                await value(window, "0")
            assert service.asked("POST", "/v1/render")[-1]["overrides"] == {"/World/Looks/Ball": {"ior": 1.7}}

    with FakeService(seconds=0.2) as service:
        asyncio.run(use(service))
