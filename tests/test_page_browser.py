"""The page in a real browser, against tests/fake_service.py. Skipped where Playwright or Chromium is not installed."""

from __future__ import annotations

import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import pytest
from fake_service import FakeService

from refract_core.images.pictures import read_texture

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
if CHROMIUM is None:
    pytest.skip("Chromium is not installed", allow_module_level=True)

pytestmark = pytest.mark.slow
PATIENCE = 60_000
"""[ms] Longest wait for what has to happen, on a machine whose cores are busy with other things."""
playwright.expect.set_options(timeout=PATIENCE)
ANGLES = ("azimuth", "elevation")
NEVER = 3600.0
"""[s] A render that takes as long shows 0 % of progress in every test."""
DONE, BOTH_DONE = "Done in 1.9 s.", "A done in 1.9 s; B done in 1.9 s."
MIDDLE = "id => [...document.getElementById(id).getContext('2d').getImageData(32, 18, 1, 1).data]"
CONTROLS = r"^\s*- (button|textbox|combobox|slider|spinbutton|checkbox|radio|progressbar)\b(?! \")"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        words = ["--no-sandbox", "--host-resolver-rules=MAP *.test 127.0.0.1"]
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=words, timeout=PATIENCE)
        yield opened
        opened.close()


@pytest.fixture
def service() -> Iterator[FakeService]:
    with FakeService(seconds=0.2) as running:
        yield running


@pytest.fixture
def page(browser: Any, service: FakeService) -> Iterator[Any]:
    """A fresh page at the service; an uncaught error or a breach of the content policy fails the test."""
    context = browser.new_context(viewport={"width": 1200, "height": 900})
    context.set_default_timeout(PATIENCE)
    opened = context.new_page()
    wrong: list[str] = []
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("console", lambda line: wrong.append(line.text) if line.type == "error" else None)
    opened.goto(service.url)
    yield opened
    context.close()
    assert [line for line in wrong if "Failed to load resource" not in line] == []


def status(page: Any, text: str) -> None:
    playwright.expect(page.locator("#status")).to_have_text(text)


def until(page: Any, true: Callable[[], bool]) -> None:
    """Wait for what the service is told beside what the page waits for."""
    end = time.monotonic() + PATIENCE / 1000
    while not true():
        assert time.monotonic() < end, "waited too long"
        page.wait_for_timeout(20)


def choose(page: Any, name: str = "ball.usda") -> None:
    page.get_by_role("button", name=name.removesuffix(".usda"), exact=True).click()


def pick(page: Any, name: str = "ball.usda") -> None:
    choose(page, name)
    status(page, DONE)
    page.wait_for_selector("#canvas-a:visible")


def asked(service: FakeService) -> Any:
    """Settings of the newest render, without what the page always asks for."""
    settings = dict(service.asked("POST", "/v1/render")[-1])
    assert "thickness" in settings.pop("aovs")
    return settings


def test_upload_render_and_change_a_slider(page: Any, service: FakeService) -> None:
    page.get_by_label("Drop a USD or glTF file here").set_input_files(
        {"name": "mine.usdz", "mimeType": "model/vnd.usdz+zip", "buffer": b"anything"}
    )
    status(page, DONE)
    page.wait_for_selector("#canvas-a:visible")
    assert asked(service) == {"stage": "mine.usdz", "image_width": 480}
    before = page.evaluate(MIDDLE, "canvas-a")
    page.get_by_label("Ball: Index of refraction, slider").press("ArrowRight")
    page.wait_for_function(f"before => String(({MIDDLE})('canvas-a')) !== String(before)", arg=before)
    assert asked(service)["overrides"] == {"/World/Looks/Ball": {"ior": 1.51}}
    assert page.locator("#glass-0-ior").input_value() == "1.51"
    assert page.get_by_role("img").get_attribute("aria-label") == "picture of mine.usdz, setting A, 64 by 36 pixels"


CORNER = "node => [...node.getContext('2d').getImageData(9, 9, 1, 1).data]"


def shows(canvas: Any, colour: list[int]) -> bool:
    return bool(canvas.evaluate(CORNER) == colour)


def test_the_first_screen_is_pictures_of_the_stages(page: Any, service: FakeService) -> None:
    """One that lies beside a stage is shown as it is, another is drawn; parts of stages are names alone."""
    cards = page.locator("#gallery canvas")
    until(page, lambda: cards.count() == 2)
    for place, colour in enumerate(([200, 80, 40, 255], [40, 80, 200, 255])):
        until(page, partial(shows, cards.nth(place), colour))
    assert service.asked("GET", "/v1/thumbnails/ball.usda") == []
    assert page.locator("#settings").is_hidden()
    page.get_by_text("1 other file").click()
    page.get_by_role("button", name="parts/wall.usda").click()
    status(page, DONE)
    assert asked(service)["stage"] == "parts/wall.usda"
    assert page.locator("#gallery").is_hidden()
    page.get_by_role("button", name="Another stage").press("Enter")
    assert page.locator("#gallery").is_visible()
    pick(page, "room.usda")
    assert page.locator("#gallery").is_hidden()


def test_sliders_start_from_what_the_file_says(page: Any, service: FakeService) -> None:
    pick(page)
    shown = {name: page.get_by_label(f"Ball: {label}, slider").input_value() for name, label in (
        ("ior", "Index of refraction"), ("roughness", "Roughness"), ("thickness", "Thickness, scene units"),
        ("absorptionDistance", "Absorption distance, scene units"),
    )}  # fmt: skip
    assert {name: float(value) for name, value in shown.items()} == pytest.approx(
        {"ior": 1.5, "roughness": 0.25, "thickness": 0.5, "absorptionDistance": 0.75}, abs=0.002
    )
    assert page.locator("#glass-0-roughness").get_attribute("placeholder") == "0.25"
    authored = page.locator("#glass-0-transmittanceColor").input_value()
    linear = page.evaluate("async (hex) => (await import('/static/glass.js')).linearOf(hex)", authored)
    assert linear == pytest.approx([0.5, 0.25, 1.0], abs=0.005)
    page.get_by_role("group", name="Ball").get_by_label("Other absorption colour").check()
    status(page, DONE)
    until(page, lambda: "overrides" in asked(service))
    assert asked(service)["overrides"]["/World/Looks/Ball"]["transmittanceColor"] == linear


def test_a_file_can_be_dropped_anywhere(page: Any, service: FakeService) -> None:
    page.evaluate("""() => {
        const data = new DataTransfer();
        data.items.add(new File(['x'], 'dropped.usda'));
        document.body.dispatchEvent(new DragEvent('drop', {dataTransfer: data, bubbles: true, cancelable: true}));
    }""")
    status(page, DONE)
    assert asked(service)["stage"] == "dropped.usda"


DROP = """names => {
    const data = new DataTransfer();
    for (const name of names) data.items.add(new File(['x'], name));
    document.body.dispatchEvent(new DragEvent('drop', {dataTransfer: data, bubbles: true, cancelable: true}));
}"""


def test_a_gltf_is_dropped_with_what_lies_beside_it(page: Any, service: FakeService) -> None:
    page.evaluate(DROP, ["vase.bin", "vase.gltf", "vase.png"])
    status(page, DONE)
    sent = asked(service)
    assert (sent["stage"], sent["beside"]) == ("vase.gltf", ["vase.bin", "vase.png"])
    page.get_by_role("button", name="Copy as curl").click()
    assert " -F stage=@vase.gltf -F file=@vase.bin -F file=@vase.png " in page.locator("#copied").input_value()
    page.evaluate(DROP, ["ball.glb"])
    playwright.expect(page.locator("#facts")).to_contain_text("ball.glb:")
    status(page, DONE)
    assert "beside" not in asked(service)


@pytest.mark.parametrize(("names", "why"), [
    (["ball.obj"], "ball.obj is neither USD nor glTF"), (["a.glb", "b.usdz"], "a.glb, b.usdz could each be"),
])  # fmt: skip
def test_what_cannot_be_a_stage_is_told_before_it_is_sent(
    page: Any, service: FakeService, names: list[str], why: str
) -> None:
    page.evaluate(DROP, names)
    playwright.expect(page.get_by_role("alert")).to_contain_text(why)
    assert service.asked("POST", "/v1/inspect") == []


def test_progress_is_told_and_cancel_ends_the_job(page: Any, service: FakeService) -> None:
    service.seconds = NEVER
    choose(page)
    status(page, "Rendering.")
    assert page.get_by_role("progressbar").is_visible()
    playwright.expect(page.locator("#picture")).to_contain_text(re.compile(r"tiles, 0 %"))
    assert len(re.findall("%", page.locator("#picture").inner_text())) == 1  # one number says how far it is
    page.get_by_role("button", name="Cancel").click()
    status(page, "Cancelled.")
    assert page.evaluate("document.activeElement.id") == "render"
    (job,) = service.jobs.values()
    until(page, lambda: job.cancelled)
    service.seconds = 0.1
    page.get_by_role("button", name="Render", exact=True).click()
    status(page, DONE)


def test_a_changed_mind_leaves_no_job_behind(page: Any, service: FakeService) -> None:
    service.seconds = NEVER
    choose(page)
    status(page, "Rendering.")
    service.seconds = 0.1
    page.get_by_label("Camera", exact=True).select_option("/World/Far")
    status(page, DONE)
    until(page, lambda: [job.cancelled for job in service.jobs.values()] == [True, False])


def test_a_refusal_names_the_field_and_leads_to_it(page: Any) -> None:
    pick(page)
    page.get_by_label("Samples per pixel").fill("2000")
    alert = page.get_by_role("alert")
    playwright.expect(alert).to_contain_text("The settings are not valid")
    playwright.expect(alert).to_contain_text("must be at most 1000")
    assert page.locator("#set-samples").get_attribute("aria-invalid") == "true"
    alert.get_by_role("link", name="/samples").click()
    assert page.evaluate("document.activeElement.id") == "set-samples"
    page.get_by_label("Samples per pixel").fill("8")
    status(page, DONE)
    assert alert.is_hidden()
    assert page.locator("#set-samples").get_attribute("aria-invalid") is None


def test_a_failed_job_shows_its_problem_and_keeps_the_last_picture(page: Any) -> None:
    pick(page)
    page.get_by_label("Surfaces of glass a ray enters").fill("13")
    status(page, "Failed.")
    alert = page.get_by_role("alert")
    for part in ("The renderer crashed", "Too deep.", "Prim: /World/Ball"):
        playwright.expect(alert).to_contain_text(part)
    playwright.expect(page.locator("#canvas-a.old")).to_be_visible()


def test_a_stage_that_cannot_be_opened_is_said_to_be_so(page: Any) -> None:
    page.get_by_label("Drop a USD or glTF file here").set_input_files(
        {"name": "broken.usda", "mimeType": "text/plain", "buffer": b"no"}
    )
    playwright.expect(page.get_by_role("alert")).to_contain_text("broken.usda is not a USD file.")
    playwright.expect(page.get_by_role("button", name="Render", exact=True)).to_be_hidden()
    status(page, "Pick a stage to begin.")
    assert page.get_by_role("button", name="ball", exact=True).is_visible()  # the choice is back


def test_nothing_stays_of_a_stage_once_another_cannot_be_opened(page: Any) -> None:
    pick(page)
    assert page.locator("#glass [data-path]").count() > 0
    page.get_by_label("Drop a USD or glTF file here").set_input_files(
        {"name": "broken.usda", "mimeType": "text/plain", "buffer": b"no"}
    )
    status(page, "Pick a stage to begin.")
    assert page.locator("#glass [data-path]").count() == 0


def test_a_picture_with_notices_says_so(page: Any) -> None:
    pick(page)
    page.get_by_label("Samples per pixel").fill("2")
    status(page, "Done in 1.9 s with 1 notice, below.")
    page.get_by_text("Notices (2)").click()
    playwright.expect(page.locator("#notices-list")).to_contain_text("/World/Block: drawn unrefined")


def test_two_settings_and_one_slider(page: Any, service: FakeService) -> None:
    pick(page)
    page.get_by_label("Ready-made comparison").select_option("model")
    status(page, BOTH_DONE)
    page.wait_for_selector("#canvas-b:visible")
    first, *both = [body.get("model") for body in service.asked("POST", "/v1/render")]
    assert (first, set(both), len(both)) == (None, {"sphere", "traced"}, 2)  # which of the two comes first, nobody says
    slider = page.get_by_label("Compare: A to the left")
    slider.press("ArrowLeft")
    assert slider.get_attribute("aria-valuetext") == "A on the left 49 %, B on the right 51 %"
    assert "49%" in page.locator("#canvas-b").evaluate("node => node.style.clipPath")
    box = page.locator("#views").bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.25, box["y"] + 20)
    assert slider.input_value() == "25"
    page.get_by_label("Edit B").check()
    page.get_by_label("Samples per pixel").fill("7")
    status(page, BOTH_DONE)
    assert asked(service) == {"stage": "ball.usda", "image_width": 480, "model": "traced", "samples": 7}
    page.get_by_label("Compare A with B").uncheck()
    assert page.locator("#canvas-b").is_hidden()


def test_planes_come_in_false_colour_with_a_legend(page: Any) -> None:
    pick(page)
    page.get_by_label("Show").select_option("thickness")
    playwright.expect(page.locator("#legend")).to_contain_text("1.24 m")  # white, as the job's record says
    page.wait_for_function(f"() => ({MIDDLE})('canvas-a')[0] !== 0")
    expected = page.evaluate("async () => (await import('/static/planes.js')).falseColour(64 / 255)")
    assert page.evaluate(MIDDLE, "canvas-a")[:3] == expected
    page.get_by_label("Show").select_option("picture")
    playwright.expect(page.locator("#legend")).to_be_hidden()


def over(page: Any, column: int, row: int) -> tuple[float, float]:
    """Where a pixel of the picture of 64 x 36 is on the screen."""
    page.locator("#views").scroll_into_view_if_needed()
    box = page.locator("#views").bounding_box()
    return box["x"] + box["width"] * (column + 0.5) / 64, box["y"] + box["height"] * (row + 0.5) / 36


def test_the_pixel_under_the_pointer_is_read_with_its_unit(page: Any) -> None:
    pick(page)
    read = page.locator("#readout")
    page.mouse.move(*over(page, 2, 3))
    playwright.expect(read).to_have_text("Pixel 2, 3: picture 8, 90, 21 of 255")
    page.get_by_label("Show").select_option("thickness")
    page.mouse.move(*over(page, 32, 18))
    playwright.expect(read).to_have_text("Pixel 32, 18: thickness 0.311 m")  # 64 / 255 of 1.24 m
    page.mouse.move(*over(page, 2, 3))
    playwright.expect(read).to_have_text("Pixel 2, 3: thickness no glass")
    page.get_by_label("Ready-made comparison").select_option("model")
    status(page, BOTH_DONE)
    page.mouse.move(*over(page, 32, 18))
    playwright.expect(read).to_have_text("Pixel 32, 18: thickness A 0.311 m; B 0.311 m")
    page.mouse.move(1, 1)
    playwright.expect(read).to_contain_text("Point at the picture")


def test_every_plane_is_read_at_the_pixel(page: Any) -> None:
    pick(page)
    page.get_by_text("Every plane at this pixel").click()
    page.mouse.move(*over(page, 32, 18))
    read = page.locator("#planes")
    for line in ("thickness 0.311 m", "depth 2.01 m", "coverage by glass 1", "normal -0.498, -0.498, -0.498"):
        playwright.expect(read.get_by_role("row", name=line)).to_be_visible()  # 64 of 255 of what white is
    page.mouse.move(*over(page, 2, 3))
    playwright.expect(read.get_by_role("row", name="thickness no glass")).to_be_visible()
    playwright.expect(read.get_by_role("row", name="Pixel 2, 3")).to_be_visible()
    page.mouse.move(1, 1)
    playwright.expect(read.get_by_role("row", name="Pixel 2, 3")).to_be_visible()  # what was read last stays


def test_a_pixel_is_read_by_touch_and_marked(browser: Any, service: FakeService) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True)
    context.set_default_timeout(PATIENCE)
    opened = context.new_page()
    opened.goto(service.url)
    pick(opened)
    opened.touchscreen.tap(*over(opened, 2, 3))
    playwright.expect(opened.locator("#readout")).to_contain_text(": picture ")
    playwright.expect(opened.locator("#mark")).to_be_visible()
    context.close()


def test_fit_and_one_to_one_change_the_size_and_nothing_else(page: Any, service: FakeService) -> None:
    pick(page)
    width = "document.getElementById('views').getBoundingClientRect().width"
    assert page.evaluate(width) > 64
    page.get_by_role("button", name="1:1").click()
    page.wait_for_function(f"() => {width} === 64")
    assert page.get_by_role("button", name="1:1").get_attribute("aria-pressed") == "true"
    page.get_by_role("button", name="Fit", exact=True).click()
    page.wait_for_function(f"() => {width} > 64")
    page.set_viewport_size({"width": 1200, "height": 300})  # all of it is seen in a low window, too
    page.wait_for_function("() => document.getElementById('views').getBoundingClientRect().height <= 300")
    assert len(service.asked("POST", "/v1/render")) == 1
    assert "azimuth" not in asked(service)


def test_the_picture_fills_the_screen_and_comes_back(page: Any) -> None:
    pick(page)
    page.get_by_role("button", name="Full screen").click()
    page.wait_for_function("() => document.fullscreenElement?.id === 'figure'")
    page.get_by_role("button", name="Leave full screen").click()
    page.wait_for_function("() => !document.fullscreenElement")
    playwright.expect(page.locator("#full")).to_have_text("Full screen")


def test_what_is_wrong_with_a_stage_is_listed_the_worst_first(page: Any) -> None:
    pick(page)
    page.get_by_role("button", name="Validate").click()
    playwright.expect(page.locator("#checked-title")).to_have_text("1 error, 1 warning")
    rows = page.locator("#checked-found li")
    playwright.expect(rows).to_have_count(2)
    for text in ("error", "/World/Looks/Ball", "ior is 0.5", "To mend it: author 1.5"):
        playwright.expect(rows.nth(0)).to_contain_text(text)
    playwright.expect(rows.nth(1)).to_contain_text("<b>odd</b>")  # as text
    page.get_by_role("button", name="Close").click()
    playwright.expect(page.locator("#checked")).to_be_hidden()
    assert page.evaluate("document.activeElement.id") == "validate"


def test_what_is_in_a_stage_can_be_read_and_taken_away(page: Any, tmp_path: Path) -> None:
    pick(page)
    page.get_by_role("button", name="Inspect").click()
    playwright.expect(page.locator("#checked-title")).to_have_text("2 glass objects, 1 thing to look at")
    glass = "sphere, index 1.5, roughness 0.25, thickness 0.5"
    playwright.expect(page.locator("#checked-found")).to_contain_text(glass)
    with page.expect_download() as taken:
        page.get_by_role("button", name="Save as JSON").click()
    assert taken.value.suggested_filename == "ball.inspect.json"
    taken.value.save_as(tmp_path / "report.json")
    assert '"refract.inspect/1"' in (tmp_path / "report.json").read_text()


def test_a_converted_stage_can_be_taken_away(page: Any, service: FakeService, tmp_path: Path) -> None:
    """And nothing stays of it once another stage is looked at."""
    pick(page)
    page.get_by_role("button", name="Convert").click()
    playwright.expect(page.locator("#checked-title")).to_have_text("1 material described")
    playwright.expect(page.locator("#checked-found")).to_contain_text("left alone")
    with page.expect_download() as taken:
        page.get_by_role("button", name="Download .usdz").click()
    assert taken.value.suggested_filename == "ball.converted.usdz"
    taken.value.save_as(tmp_path / "made.usdz")
    assert (tmp_path / "made.usdz").read_bytes() == b"a converted stage"
    assert [body["stage"] for body in service.asked("POST", "/v1/convert")] == ["ball.usda"]
    page.get_by_role("button", name="Another stage").click()
    choose(page, "room.usda")
    playwright.expect(page.locator("#checked")).to_be_hidden()


@pytest.mark.parametrize(("verb", "button", "option", "value", "asked"), [
    ("convert", "Convert", "Also described for", "gltf", {"to": "gltf"}),
    ("bake-thickness", "Bake thickness", "Kept in", "512", {"texture": 512}),
    ("bake-probes", "Bake probes", "Texels of a face", "64", {"resolution": 64}),
])  # fmt: skip
def test_how_a_stage_is_made_can_be_chosen(
    page: Any, service: FakeService, verb: str, button: str, option: str, value: str, asked: dict[str, Any]
) -> None:
    """By itself as the command line does it; a choice asks again, and leaving it asks for nothing once more."""
    pick(page)
    page.get_by_role("button", name=button).click()
    playwright.expect(page.get_by_role("button", name="Download .usdz")).to_be_visible()
    page.get_by_label(option).select_option(value)
    until(page, lambda: len(service.asked("POST", f"/v1/{verb}")) == 2)
    page.get_by_label(option).select_option("")
    until(page, lambda: len(service.asked("POST", f"/v1/{verb}")) == 3)
    told = [{name: body[name] for name in body if name != "stage"} for body in service.asked("POST", f"/v1/{verb}")]
    assert told == [{}, asked, {}]


def test_a_baked_stage_can_be_taken_away(page: Any, tmp_path: Path) -> None:
    pick(page)
    page.get_by_role("button", name="Bake thickness").click()
    playwright.expect(page.locator("#checked-title")).to_have_text("1 prims measured along normal, 1 left alone")
    playwright.expect(page.locator("#checked-found")).to_contain_text("2 to 2, mean 2")
    playwright.expect(page.locator("#checked-found")).to_contain_text("is open")
    with page.expect_download() as taken:
        page.get_by_role("button", name="Download .usdz").click()
    assert taken.value.suggested_filename == "ball.thickness.usdz"
    taken.value.save_as(tmp_path / "made.usdz")
    assert (tmp_path / "made.usdz").read_bytes() == b"a baked stage"


def test_tier_order_by_keyboard(page: Any, service: FakeService) -> None:
    pick(page)
    page.get_by_role("button", name="Move probe up").press("Enter")
    playwright.expect(page.locator("#tiers li").first).to_contain_text("1. probe")
    assert page.evaluate("document.activeElement.id") == "tier-probe"  # up is off now; the row keeps the focus
    page.get_by_label("ray (not asked)").press(" ")
    status(page, DONE)
    assert asked(service)["tiers"] == ["probe", "screen", "sky", "ray"]


def test_tier_order_by_dragging(page: Any, service: FakeService) -> None:
    pick(page)
    page.locator("#tiers li").nth(2).drag_to(page.locator("#tiers li").nth(0))
    playwright.expect(page.locator("#tiers li").first).to_contain_text("1. sky")
    status(page, DONE)
    assert asked(service)["tiers"] == ["sky", "screen", "probe"]


def turned(service: FakeService) -> Any:
    ours = ("azimuth", "elevation", "distance", "camera")
    return {name: value for name, value in asked(service).items() if name in ours}


def drag(page: Any, right: int, down: int) -> None:
    box = page.locator("#views").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + right, y + down, steps=4)
    page.mouse.up()


def small(service: FakeService) -> list[Any]:
    """Requests for small pictures."""
    asked = service.asked("POST", "/v1/render") + service.asked("POST", "/v1/live/")
    return [body for body in asked if body.get("quality") == "draft"]


@pytest.mark.parametrize("viewer", ["a", ""], ids=["by a viewer", "where there is no place for one"])
def test_dragging_turns_the_camera_with_small_pictures_on_the_way(
    page: Any, service: FakeService, viewer: str
) -> None:
    """From where the stage's camera stands, which the job of the first picture has told."""
    service.viewer = viewer
    pick(page)
    drag(page, -50, 25)
    until(page, lambda: not small_last(service) and "azimuth" in asked(service))
    status(page, DONE)
    expected = {"camera": "/World/Near", "azimuth": 30.0, "elevation": 30.0, "distance": 4.0}
    assert turned(service) == pytest.approx(expected)
    on_the_way = small(service)
    assert on_the_way
    assert bool(service.asked("POST", "/v1/live/")) is bool(viewer)
    for body in on_the_way:
        assert 128 <= body["image_width"] <= 320
        assert body["image_height"] == pytest.approx(body["image_width"] * 36 / 64, abs=0.5)
    assert on_the_way[-1]["azimuth"] == pytest.approx(30.0)  # the last of them is of where it stands
    assert page.locator("#set-azimuth").input_value() == "30"
    page.get_by_role("button", name="Camera back").click()
    status(page, "Changed, about to render.")
    status(page, DONE)
    assert turned(service) == {}


def test_a_viewer_that_has_ended_is_followed_by_another(page: Any, service: FakeService) -> None:
    pick(page)
    drag(page, -50, 0)
    until(page, lambda: len(service.asked("POST", "/v1/live/a/")) > 0)
    status(page, DONE)
    service.viewer = "b"
    drag(page, -50, 0)
    until(page, lambda: len(service.asked("POST", "/v1/live/b/")) > 0)
    status(page, DONE)
    assert [body["stage"] for how, path, body in service.log if path == "/v1/live"] == ["ball.usda", "ball.usda"]
    page.get_by_role("button", name="Another stage").click()
    pick(page, "room.usda")
    until(page, lambda: service.asked("DELETE", "/v1/live/b") == [None])  # its place is for others


def test_a_stage_that_moves_is_played_and_stops_where_it_is_told(page: Any, service: FakeService) -> None:
    page.evaluate(DROP, ["moving.usda"])
    status(page, DONE)
    page.wait_for_selector("#canvas-a:visible")
    page.get_by_role("button", name="Play").click()
    live = lambda: {body.get("time_code") for body in service.asked("POST", "/v1/live/")}  # noqa: E731
    until(page, lambda: len(live()) > 3)
    page.get_by_role("button", name="Pause").click()
    status(page, DONE)
    stands = float(page.locator("#time-now").inner_text())
    until(page, lambda: asked(service).get("time_code") == stands)
    assert live() <= {*map(float, range(1, 49))}
    page.get_by_role("slider", name="Time").fill("7")
    until(page, lambda: not small_last(service) and asked(service).get("time_code") == 7)
    status(page, DONE)
    page.get_by_role("button", name="Another stage").click()
    pick(page)  # which stands still
    assert page.locator("#timing").is_hidden()


def small_last(service: FakeService) -> bool:
    return service.asked("POST", "/v1/render")[-1].get("quality") == "draft"


def test_the_wheel_and_keys_move_the_camera_too(page: Any, service: FakeService) -> None:
    pick(page)
    page.locator("#views").hover()
    page.mouse.wheel(0, -100)
    until(page, lambda: not small_last(service) and "distance" in asked(service))
    nearer = turned(service)["distance"]
    assert nearer < 4.0
    status(page, DONE)
    page.locator("#views").press("ArrowRight")
    until(page, lambda: not small_last(service) and asked(service).get("azimuth") == 15.0)
    status(page, DONE)
    page.locator("#views").press("Home")
    until(page, lambda: not small_last(service) and turned(service) == {})
    status(page, DONE)


def test_both_sides_of_a_comparison_are_seen_by_one_camera(page: Any, service: FakeService) -> None:
    pick(page)
    page.get_by_label("Ready-made comparison").select_option("model")
    status(page, BOTH_DONE)
    page.get_by_label("Azimuth, degrees").fill("40")
    until(page, lambda: [body.get("azimuth") for body in service.asked("POST", "/v1/render")[-2:]] == [40, 40])
    status(page, BOTH_DONE)
    assert {body["model"] for body in service.asked("POST", "/v1/render")[-2:]} == {"sphere", "traced"}


def test_a_link_opens_the_same_view(page: Any, service: FakeService) -> None:
    pick(page, "room.usda")
    page.get_by_role("group", name="Ball").get_by_label("Other absorption colour").check()
    page.locator("#glass-0-transmittanceColor").fill("#ff0000")
    page.get_by_label("Ready-made comparison").select_option("screen")
    status(page, BOTH_DONE)
    before = set(service.jobs)
    page.get_by_role("button", name="Copy link").click()
    link = page.get_by_label(re.compile("^Link")).input_value()
    other = page.context.new_page()
    other.goto(link)
    status(other, BOTH_DONE)
    playwright.expect(other.locator("#canvas-b")).to_be_visible()
    playwright.expect(other.locator("#facts")).to_contain_text("room.usda:")
    assert other.locator("#glass-0-transmittanceColor").input_value() == "#ff0000"
    assert asked(service)["overrides"] == {"/World/Looks/Ball": {"transmittanceColor": [1, 0, 0]}}
    assert set(service.jobs) == before  # the link's two renders are those that were there: same request, same job


def test_commands_are_copied(page: Any) -> None:
    pick(page)
    page.get_by_role("button", name="Copy as curl").click()
    assert page.locator("#copied").input_value().startswith("curl ")
    page.get_by_role("button", name="Copy as CLI").click()
    assert page.locator("#copied").input_value() == "refract render ball.usda ball.png --image-width 480"
    assert page.evaluate("document.activeElement.id") == "copied"
    page.get_by_label("Ball: Index of refraction, slider").press("ArrowRight")
    status(page, DONE)
    page.get_by_role("button", name="Copy as CLI").click()
    assert page.locator("#copied").input_value().endswith(" --override /World/Looks/Ball.ior=1.51")


def test_a_token_is_asked_for_where_one_is_needed(page: Any, service: FakeService) -> None:
    service.token = "secret"
    page.reload()
    page.get_by_label("Access token").fill("secret")
    page.get_by_label("Access token").press("Enter")
    pick(page)
    assert "secret" not in page.url


def test_text_of_a_stage_is_never_markup(page: Any) -> None:
    pick(page)
    page.get_by_text("Notices (1)").click()
    playwright.expect(page.locator("#notices-list")).to_contain_text("<b>odd</b>")
    assert page.locator("#notices-list b").count() == 0


def test_every_control_has_a_name_for_a_screen_reader(page: Any) -> None:
    pick(page)
    page.get_by_label("Ready-made comparison").select_option("model")
    page.wait_for_selector("#canvas-b:visible")
    page.evaluate("for (const node of document.querySelectorAll('details')) node.open = true")
    lines = page.locator("body").aria_snapshot().splitlines()
    assert len([line for line in lines if re.match(r"^\s*- (button|slider|spinbutton)", line)]) > 20
    assert [line for line in lines if re.match(CONTROLS, line)] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_narrow_screen(page: Any, scheme: str) -> None:
    page.set_viewport_size({"width": 360, "height": 740})
    page.emulate_media(color_scheme=scheme)
    pick(page)
    page.get_by_label("Ready-made comparison").select_option("model")
    page.wait_for_selector("#canvas-b:visible")
    page.evaluate("for (const node of document.querySelectorAll('details')) node.open = true")
    assert page.evaluate("document.documentElement.scrollWidth") == 360


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_axe_finds_nothing(page: Any, scheme: str, width: int) -> None:
    """axe-core's own rules, on the first screen, with everything open, and where something went wrong."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()

    def found() -> list[tuple[str, list[Any]]]:
        return [(one["id"], [node["target"] for node in one["nodes"]]) for one in axe.run(page).response["violations"]]

    page.set_viewport_size({"width": width, "height": 844})
    page.emulate_media(color_scheme=scheme)
    playwright.expect(page.locator("#gallery canvas")).to_have_count(2)
    assert found() == []
    page.evaluate(DROP, ["moving.usda"])
    status(page, DONE)
    page.get_by_label("Ready-made comparison").select_option("model")
    status(page, BOTH_DONE)
    page.get_by_label("Show").select_option("thickness")
    playwright.expect(page.locator("#legend")).to_be_visible()
    page.get_by_role("button", name="Validate").click()
    playwright.expect(page.locator("#checked-found li")).to_have_count(2)
    page.evaluate("for (const node of document.querySelectorAll('details')) node.open = true")
    assert found() == []
    page.evaluate(DROP, ["ball.obj"])
    playwright.expect(page.get_by_role("alert")).to_be_visible()
    assert found() == []


# --- the service itself ---------------------------------------------------------------------------------------------

SERVE = """
import sys
from service.app import Settings
from service.serve import serve
serve(Settings(stage_root=sys.argv[1], data=sys.argv[2], workers=1, allow_origins=tuple(sys.argv[3:])), "127.0.0.1", 0)
"""


@pytest.fixture
def site_port(tmp_path: Path) -> Iterator[int]:
    """Of a web server with an empty page, which goes by any name."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<!doctype html><title>a site</title>")
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "site"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as site:
        thread = threading.Thread(target=site.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield site.server_address[1]
        site.shutdown()
        thread.join()


@pytest.fixture
def real_url(tmp_path: Path, site_port: int) -> Iterator[str]:
    """Address of the real service over the good samples. It lets in pages of shop.test."""
    pytest.importorskip("service.serve")
    root = Path(__file__).parents[1]
    shop = f"http://shop.test:{site_port}"
    command = [sys.executable, "-c", SERVE, str(root / "usd_samples" / "good"), str(tmp_path / "data"), shop]
    with Popen(command, stdout=PIPE, text=True, cwd=root) as process:
        assert process.stdout is not None
        said = next(line for line in process.stdout if "http://" in line)
        yield said[said.index("http://") :].strip()
        process.terminate()
        process.wait(PATIENCE / 1000)


def test_against_the_real_service(browser: Any, real_url: str) -> None:
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    opened.goto(f'{real_url}#stage=marble.usda&a={{"image_width":64,"samples":1}}')
    took = re.compile(r"^Done in [\d.]+ s\.$")
    done = lambda: playwright.expect(opened.locator("#status")).to_have_text(took, timeout=900_000)  # noqa: E731
    done()  # the first worker may have to compile its kernels
    opened.wait_for_selector("#canvas-a:visible")
    assert opened.evaluate("document.getElementById('canvas-a').width") == 64
    before = opened.evaluate(MIDDLE, "canvas-a")
    opened.get_by_label("Clear: Index of refraction, slider").fill("1.05")
    opened.wait_for_function(f"before => String(({MIDDLE})('canvas-a')) !== String(before)", arg=before)
    done()
    opened.get_by_label("Show").select_option("thickness")
    playwright.expect(opened.locator("#legend")).to_contain_text("1.24 m")
    opened.get_by_label("Samples per pixel").fill("4096")
    playwright.expect(opened.get_by_role("alert")).to_contain_text("limit")
    opened.close()


PIXELS = """node => [node.width, node.height,
    ...node.getContext('2d').getImageData(0, 0, node.width, node.height).data]"""


def test_a_turned_picture_is_the_render_of_the_camera_that_the_page_shows(browser: Any, real_url: str) -> None:
    """From the pixels of a drag to those of the picture: 50 to the right and 25 down are 20 degrees to the left and
    10 up, for what is near follows the hand."""
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    asked: list[Any] = []
    opened.on("request", lambda one: asked.append(one.post_data_json) if one.url.endswith("/v1/render") else None)
    opened.goto(f'{real_url}#stage=marble.usda&a={{"image_width":64,"samples":1}}')
    took = re.compile(r"^Done in [\d.]+ s\.$")
    playwright.expect(opened.locator("#status")).to_have_text(took, timeout=900_000)  # kernels may have to be compiled
    start = {name: float(opened.locator(f"#set-{name}").get_attribute("placeholder")) for name in ANGLES}
    drag(opened, 50, 25)
    until(opened, lambda: "azimuth" in asked[-1] and "aovs" in asked[-1])
    playwright.expect(opened.locator("#status")).to_have_text(took)
    shown = {name: float(opened.locator(f"#set-{name}").input_value()) for name in (*ANGLES, "distance")}
    turn = [shown[name] - start[name] for name in ANGLES]
    assert turn == pytest.approx([-20.0, 10.0], abs=0.01)
    wish = {"stage": "marble.usda", "image_width": 64, "samples": 1, "camera": "/World/Camera", **shown}

    def rendered(**other: float) -> tuple[int, int, bytes]:
        body = {**wish, "look_at": asked[-1]["look_at"], **other}
        answer = opened.request.post(f"{real_url}v1/render", data=body, headers={"Accept": "image/png"})
        assert answer.status == 200, answer.text()
        picture = read_texture(answer.body(), name="picture", color_space="raw").pixels
        high, wide = picture.shape[:2]
        return wide, high, picture[..., :3].tobytes()

    wide, high, *values = opened.locator("#canvas-a").evaluate(PIXELS)
    colours = bytes(value for place, value in enumerate(values) if place % 4 < 3)
    assert (wide, high, colours) == rendered()
    assert colours != rendered(azimuth=-shown["azimuth"])[2]
    opened.close()


def test_every_operation_can_be_tried_on_the_page_of_the_interface(browser: Any, real_url: str) -> None:
    """Under the policy that all pages have: no script or style but the service's own."""
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    wrong: list[str] = []
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("console", lambda line: wrong.append(line.text) if line.type == "error" else None)
    opened.goto(f"{real_url}docs")
    playwright.expect(opened.get_by_text("/v1/render", exact=True)).to_be_visible()
    opened.get_by_text("/v1/limits", exact=True).click()
    opened.get_by_role("button", name="Try it out").click()
    opened.get_by_role("button", name="Execute").click()
    playwright.expect(opened.locator(".live-responses-table")).to_contain_text("job_seconds")
    assert not wrong
    opened.close()


def test_a_page_of_a_name_bound_anew_is_shown_nothing(browser: Any, real_url: str) -> None:
    """DNS rebinding: this browser is told that evil.test is this machine."""
    port = real_url.rstrip("/").rpartition(":")[2]
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    answer = opened.goto(f"http://evil.test:{port}/v1/stages")
    assert (answer.status, "marble" in answer.text()) == (421, False)
    asked = opened.evaluate("async () => { const a = await fetch('/v1/stages'); return [a.status, await a.text()] }")
    assert (asked[0], "marble" in asked[1]) == (421, False)
    assert "marble.usda" in opened.goto(f"{real_url}v1/stages").text()
    opened.close()


ASK = """async ([url, method]) => {
    const headers = {"Content-Type": "application/json", "Authorization": "Bearer none", "Prefer": "respond-async"};
    const body = method === "POST" ? '{"stage": "marble.usda", "samples": 4000}' : undefined;
    try {
        const answer = await fetch(url, {method, headers, body});
        return [answer.status, await answer.text(), answer.headers.get("X-Request-ID")];
    } catch (error) { return [0, "", null] }
}"""


@pytest.mark.parametrize(("site", "allowed"), [("shop.test", True), ("evil.test", False)])
def test_only_an_allowed_site_asks_and_reads(browser: Any, site_port: int, real_url: str, site: str,
                                             allowed: bool) -> None:  # fmt: skip
    """With headers that make a browser ask first."""
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    opened.goto(f"http://{site}:{site_port}/")
    read = opened.evaluate(ASK, [f"{real_url}v1/stages", "GET"])
    written = opened.evaluate(ASK, [f"{real_url}v1/render", "POST"])
    assert (read[0], written[0]) == ((200, 422) if allowed else (0, 0))
    assert ("marble.usda" in read[1], "limit-exceeded" in written[1]) == (allowed, allowed)
    assert (read[2] is not None) is allowed
    opened.close()
