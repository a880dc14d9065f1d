"""The page's markup, colours and the part of its script that needs no browser. tests/test_page_browser.py drives it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from fake_service import Job

from refract_core.images.aovs import AOVS
from refract_core.settings import MODELS, SCREEN_METHODS, TIERS, RenderSettings
from service import pages

STATIC = Path(__file__).parents[1] / "service" / "static"
MARKUP = (STATIC / "index.html").read_text("utf-8")
MODULES = {path.name: path.read_text("utf-8") for path in sorted(STATIC.glob("*.js"))}
MODULES["words.js"] = pages.words()
SCRIPT = "\n".join(MODULES.values())
STYLE = (STATIC / "page.css").read_text("utf-8")
FACTS = {"up_axis": "Z", "metres_per_unit": 0.01, "settings": {"tiers": ["screen", "probe", "sky"], "samples": 4}}


class Page(HTMLParser):
    """Every start tag with its attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.feed(MARKUP)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))


TAGS = Page().tags
IDS = [attributes["id"] for _, attributes in TAGS if "id" in attributes]


# --- markup ---------------------------------------------------------------------------------------------------------


def test_ids_are_unique_and_every_reference_lands() -> None:
    assert len(IDS) == len(set(IDS))
    for _, attributes in TAGS:
        for name in ("for", "aria-labelledby", "aria-describedby"):
            assert set(attributes.get(name, "").split()) <= set(IDS)
        if attributes.get("href", "").startswith("#"):
            assert attributes["href"][1:] in IDS


def test_the_script_knows_only_ids_that_exist() -> None:
    asked = set(re.findall(r'\$\("([\w-]+)"\)', SCRIPT))
    assert len(asked) > 20
    assert asked <= set(IDS)


def test_every_control_has_a_name() -> None:
    labelled = {attributes["for"] for tag, attributes in TAGS if tag == "label" and "for" in attributes}
    wrapped = re.findall(r'<label class="tick"><input [^>]*id="([\w-]+)"[^>]*>\s*\w', MARKUP)
    for tag, attributes in TAGS:
        if tag in ("input", "select", "textarea", "progress"):
            assert attributes["id"] in labelled | set(wrapped), attributes
    assert not re.search(r"<button[^>]*>\s*</button>", MARKUP)


def test_the_page_says_its_language_its_title_and_what_changes() -> None:
    assert ("html", {"lang": "en"}) in TAGS
    assert "<title>" in MARKUP
    assert {tag for tag, _ in TAGS} >= {"main", "header", "h1", "h2", "nav"}
    roles = {attributes["id"]: attributes.get("role") for _, attributes in TAGS if "id" in attributes}
    assert roles["status"] == "status"
    assert roles["problem"] == "alert"


def test_nothing_comes_from_elsewhere_and_nothing_is_inline() -> None:
    for tag, attributes in TAGS:
        for name in ("src", "href"):
            assert "//" not in attributes.get(name, "")
        assert "style" not in attributes
        assert not any(name.startswith("on") for name in attributes)
        assert tag != "style"
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", SCRIPT + STYLE + MARKUP)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b", SCRIPT)


def test_every_file_is_short() -> None:
    lengths = {path.name: len(path.read_text("utf-8").splitlines()) for path in STATIC.rglob("*") if path.is_file()}
    assert {name: lines for name, lines in lengths.items() if lines > 400} == {}


def test_modules_take_what_others_give_and_never_each_other_in_a_ring() -> None:
    taken = {name: re.findall(r'^import \{ (.*) \} from "\./([\w.]+)";$', text, re.M) for name, text in MODULES.items()}
    assert sum(map(len, taken.values())) == len(re.findall(r"\bimport\b", SCRIPT)) > 20
    for rows in taken.values():
        for names, where in rows:
            given = set(re.findall(r"^export (?:async )?(?:const|let|function|class) ([\w$]+)", MODULES[where], re.M))
            assert set(names.split(", ")) <= given, where
    below = {name: {where for _, where in rows} for name, rows in taken.items()}
    assert set(MODULES) - {"page.js"} == set().union(*below.values())  # the first one alone stands in the markup
    while leaves := {name for name, rows in below.items() if not rows & below.keys()}:
        below = {name: rows for name, rows in below.items() if name not in leaves}
    assert below == {}


def test_views_are_planes_of_a_frame() -> None:
    views = re.findall(r'<option value="([\w.]+)">', MARKUP[MARKUP.index('id="view"') :].split("</select>")[0])
    assert len(views) == len(set(views)) > 10
    assert set(views) <= set(AOVS)


# --- contrast (WCAG 2.2, 1.4.3 and 1.4.11) --------------------------------------------------------------------------


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb, as WCAG defines it."""
    values = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    red, green, blue = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def palettes() -> list[dict[str, str]]:
    blocks = re.findall(r":root \{([^}]*)\}", STYLE)
    found = [dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block)) for block in blocks]
    return [found[0], {**found[0], **found[1]}]


@pytest.mark.parametrize("palette", palettes(), ids=["light", "dark"])
@pytest.mark.parametrize(
    ("front", "back", "least"),
    [
        ("ink", "ground", 4.5), ("ink", "panel", 4.5), ("quiet", "ground", 4.5), ("quiet", "panel", 4.5),
        ("accent", "panel", 4.5), ("accent", "ground", 4.5), ("on-accent", "accent", 4.5), ("bad", "bad-ground", 4.5),
        ("edge", "panel", 3.0), ("edge", "ground", 3.0), ("bad", "panel", 3.0),
    ],
)  # fmt: skip
def test_contrast(palette: dict[str, str], front: str, back: str, least: float) -> None:
    dark, light = sorted((luminance(palette[front]), luminance(palette[back])))
    assert (light + 0.05) / (dark + 0.05) >= least


# --- the script without a document ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    folder = tmp_path_factory.mktemp("page")
    (folder / "package.json").write_text('{"type": "module"}')
    for name, text in MODULES.items():
        (folder / name).write_text(text, "utf-8")
    names = [name for name in MODULES if name != "page.js"]  # that one begins the page; no other needs a document
    (folder / "all.js").write_text("".join(f'export * from "./{name}";' for name in names))
    return folder / "all.js"


def js(module: Path, expression: str, **given: Any) -> Any:
    """Value of an expression over what the modules export (as `page`) and `given`."""
    names = "".join(f"const {name} = {json.dumps(value)};" for name, value in given.items())
    load = f"import * as page from {json.dumps(module.as_uri())};"
    command = ["node", "--input-type=module", "--eval", f"{load}{names}console.log(JSON.stringify({expression}))"]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)


def test_the_page_knows_the_engines_words(module: Path) -> None:
    assert js(module, "page.TIERS") == list(TIERS)
    assert js(module, "page.MODELS") == list(MODELS)
    assert js(module, "page.SCREENS") == list(SCREEN_METHODS)


def test_settings_are_those_of_the_engine_and_what_is_usual_is_not_sent(module: Path) -> None:
    usual = js(module, "page.defaultSettings(null)")
    orbit = {"azimuth", "elevation", "distance", "look_at"}
    assert set(usual) - set(RenderSettings.__dataclass_fields__) - orbit == {"overrides", "time_code"}
    known = {"camera", "samples", "exposure", "screen", "model", "max_layers", "image_height"}
    assert {name: usual[name] for name in known} == {name: getattr(RenderSettings(), name) for name in known}
    assert js(module, "page.requestSettings(page.defaultSettings(facts), facts)", facts=FACTS) == {"image_width": 480}


def test_the_service_takes_every_setting_of_the_page_and_the_stand_in_answers_as_it_does(module: Path) -> None:
    models = pytest.importorskip("service.models")
    override = {"model": "box", "ior": 1.2, "thickness": 1, "roughness": 0.5, "transmittanceColor": [1, 0, 0.5],
                "absorptionDistance": 2, "abbeNumber": 30}  # fmt: skip
    asked = js(
        module,
        "page.requestSettings(page.cleanSettings(given, null), null)",
        given={"overrides": {"/World/Glass": override}},
    )
    taken = models.Render.model_validate({"stage": "a.usda", **asked})
    assert taken.overrides["/World/Glass"].model_dump() == override
    document = Job("0", {"aovs": ["thickness"]}, 0.0).document()
    assert models.Job.model_validate(document).model_dump().keys() == document.keys()
    models.Render.model_validate({"stage": "a.usda", "aovs": js(module, "page.AOVS")})


def test_what_the_stage_authors_is_where_its_settings_start(module: Path) -> None:
    facts = {"settings": {"tiers": ["ray", "sky"], "samples": 9, "max_layers": 2}}
    asked = "page.requestSettings({...page.defaultSettings(facts), samples: 4}, facts)"
    assert js(module, "page.defaultSettings(facts).tiers", facts=facts) == ["ray", "sky"]
    assert js(module, asked, facts=facts) == {"image_width": 480, "samples": 4}


def test_a_link_brings_the_same_settings_back(module: Path) -> None:
    override = {"/World/Looks/A&B": {"ior": 1.33, "model": "box", "transmittanceColor": [1, 0.5, 0.25]}}
    a = {"image_width": 320, "tiers": ["ray", "probe"], "overrides": override, "camera": "/World/C#m", "exposure": -1.5}
    state = {"source": {"name": "a b.usda"}, "facts": FACTS, "compare": True, "view": "thickness", "split": 30}
    settings = "{a: page.cleanSettings(a, state.facts), b: page.cleanSettings({}, state.facts)}"
    there_and_back = f"page.fromFragment('#' + page.toFragment({{...state, settings: {settings}}}))"
    link = js(module, there_and_back, state=state, a=a)
    assert (link["stage"], link["view"], link["split"]) == ("a b.usda", "thickness", 30)
    assert link["a"] == a
    assert link["b"] == {"image_width": 480}


def test_turning_keeps_to_the_sphere_and_a_move_to_the_plane_of_the_picture(module: Path) -> None:
    view = {"azimuth": 170.0, "elevation": 80.0, "distance": 4.0, "look_at": [1.0, 2.0, 3.0]}
    turned = js(module, "page.turned(view, 20, 30, 2)", view=view)
    assert turned == {"azimuth": -170.0, "elevation": 89.0, "distance": 2.0, "look_at": [1.0, 2.0, 3.0]}
    for up, axes in (("Y", (0, 1, 2)), ("Z", (0, 2, 1))):
        front: dict[str, Any] = {"azimuth": 0, "elevation": 0, "distance": 4.0, "look_at": [1.0, 2.0, 3.0]}
        moved = js(module, "page.moved(view, 0.5, 0.25, 0.5, up).look_at", view=front, up=up)
        step = [after - before for after, before in zip(moved, front["look_at"], strict=True)]
        assert [step[axis] for axis in axes] == pytest.approx([1.0, 0.5, 0.0])  # half, a quarter of 4 x 0.5 to see
        side = {"azimuth": 90, "elevation": 0, "distance": 4.0, "look_at": [0.0, 0.0, 0.0]}
        moved = js(module, "page.moved(view, 0.5, 0, 0.5, up).look_at", view=side, up=up)
        assert moved[axes[2]] == pytest.approx(-1.0 if up == "Y" else 1.0)  # from +X, the right is the back


def test_a_small_picture_asks_for_the_same_but_less(module: Path) -> None:
    request = {"image_width": 960, "samples": 64, "ior": 1.3, "azimuth": 5, "camera": "/C"}
    small = js(module, "page.smallRequest(request, 2)", request=request)
    kept = {"ior": 1.3, "azimuth": 5, "camera": "/C"}
    assert small == {"image_width": 320, "image_height": 160, "quality": "draft", "samples": 1, **kept}


def test_small_pictures_become_as_large_as_is_quick_enough(module: Path) -> None:
    """Time goes with the pixels: so sized that one takes a tenth of a second, within bounds."""
    settled = """(() => {
        let width = 320;
        for (let turn = 0; turn < 20; turn++) width = page.nextWidth(width, width * width * perPixel);
        return width;
    })()"""
    for milliseconds, expected in ((1, 320), (100, 320), (400, 160), (100_000, 128)):
        assert js(module, settled, perPixel=milliseconds / 320**2) == pytest.approx(expected, abs=2)


@pytest.mark.parametrize(
    "given",
    [None, 7, "x", [], {"tiers": "ray"}, {"tiers": ["moon"]}, {"screen": "__proto__"}, {"samples": "9"}, {"model": 3},
     {"overrides": {"not/a/path": {"ior": 2}}}, {"overrides": {"/W": {"ior": "2", "evil": 1}}}, {"unknown": 1},
     {"azimuth": "9"}, {"look_at": [1, 2]}, {"look_at": "/World"}, {"look_at": [1, 2, "3"]}],
)  # fmt: skip
def test_a_hand_made_link_cannot_bring_other_things(module: Path, given: Any) -> None:
    same = "JSON.stringify(page.cleanSettings(given, null)) === JSON.stringify(page.defaultSettings(null))"
    assert js(module, same, given=given) is True


def run_shell(command: str, folder: Path) -> list[str]:
    """Run a command whose programs are stubs; the words the last one was called with."""
    bin_folder = folder / "bin"
    bin_folder.mkdir()
    for name in ("refract", "curl"):
        (bin_folder / name).write_text('#!/bin/sh\nprintf "%s\\0" "$@" > words\n')
        (bin_folder / name).chmod(0o755)
    path = f"{bin_folder}:/usr/bin:/bin"
    subprocess.run(["sh", "-c", command], cwd=folder, check=True, timeout=30, env={"PATH": path})
    return (folder / "words").read_bytes().decode().split("\0")[:-1]


def test_curl_command_for_a_sample_survives_a_shell(module: Path, tmp_path: Path) -> None:
    name = 'it\'s $(x) "odd".usda'
    given: dict[str, Any] = {"source": {"name": name}, "request": {"image_width": 32, "camera": "/A'B"}}
    words = run_shell(js(module, "page.asCurl('http://h:1/v1/render', source, request)", **given), tmp_path)
    assert json.loads(words[words.index("-d") + 1]) == {"stage": name, **given["request"]}
    assert "http://h:1/v1/render" in words
    assert words[-1].endswith(".png")


def test_curl_command_for_an_upload_names_the_file(module: Path, tmp_path: Path) -> None:
    given = {"source": {"name": "a;b.usdz", "file": {}}, "request": {"image_width": 32, "screen": "proxy"}}
    words = run_shell(js(module, "page.asCurl('http://h:1/v1/render', source, request)", **given), tmp_path)
    assert words[words.index("-F") + 1] == 'stage=@"a;b.usdz"'  # curl reads a bare ; as the start of a type
    sent = words[words.index("--form-string") + 1].removeprefix("settings=")
    assert json.loads(sent) == given["request"]


def test_cli_command_is_one_that_the_command_line_takes(module: Path, tmp_path: Path) -> None:
    import typer

    from refract_core.cli import app

    request = {
        "image_width": 64, "image_height": 36, "samples": 2, "tiers": ["ray", "sky"], "screen": "proxy",
        "model": "thin", "max_layers": 2, "exposure": -1.5, "camera": "/World/Camera", "time_code": 3,
    }  # fmt: skip
    words = run_shell(js(module, "page.asCli({name: 'a b.usda'}, request)", request=request), tmp_path)
    command: Any = typer.main.get_command(app)
    context = command.make_context("refract", words[:1], resilient_parsing=True)
    taken = command.get_command(context, "render").make_context("render", words[1:]).params
    assert taken["stage"] == "a b.usda"
    assert "####" in taken["out"]
    assert taken["tiers"] == "ray,sky"
    assert taken["exposure"] == -1.5
    assert taken["frames"] == "3"
    assert {name: taken[name] for name in ("samples", "model", "camera")} == {
        "samples": 2, "model": "thin", "camera": ["/World/Camera"],
    }  # fmt: skip


def test_cli_command_says_overrides_as_http_does(module: Path, tmp_path: Path) -> None:
    from refract_core.cli.render import materials_of

    override = {"ior": 1.7, "thickness": 2.5, "model": "box", "roughness": 1e-7, "transmittanceColor": [1, 0.5, 0.25]}
    request = {"image_width": 64, "overrides": {"/L/It's 'Glass'": override, "/L/Ω": {"ior": 2}}}
    command = js(module, "page.asCli({name: 'glass.usda'}, request)", request=request)
    assert "\n" not in command
    words = run_shell(command, tmp_path)
    assert words[:5] == ["render", "glass.usda", "glass.png", "--image-width", "64"]
    given = [value for word, value in pairwise(words) if word == "--override"]
    expected = {"/L/It's 'Glass'": {**override, "transmittanceColor": (1, 0.5, 0.25)}, "/L/Ω": {"ior": 2}}
    assert materials_of(given) == expected


def chunks(png: bytes) -> list[bytes]:
    """Type and data of each chunk of a PNG, without length and checksum."""
    found, at = [], 8
    while at < len(png):
        size = int.from_bytes(png[at : at + 4], "big")
        found.append(png[at + 4 : at + 8 + size])
        at += size + 12
    return found


@pytest.mark.slow
def test_the_copied_command_makes_the_bytes_that_the_service_makes(module: Path, tmp_path: Path) -> None:
    """For the request that the page sends: other values in two materials, other tiers, another time."""
    service_server = pytest.importorskip("service_server")
    samples = tmp_path / "samples"
    shutil.copytree(service_server.ROOT / "usd_samples" / "good", samples)
    amber = {"model": "box", "ior": 1.21, "thickness": 0.3, "roughness": 0.15, "absorptionDistance": 0.7}
    given = {
        "image_width": 48, "samples": 2, "tiers": ["ray", "sky"], "exposure": -0.5, "time_code": 3,
        "overrides": {"/World/Amber": {**amber, "transmittanceColor": [1, 0.5, 0.25]}, "/World/Sea": {"model": "thin"}},
    }  # fmt: skip
    wish = "page.requestSettings(page.cleanSettings(given, null), null)"
    request, command = js(module, f"[{wish}, page.asCli({{name: 'marble.usda'}}, {wish})]", given=given)
    assert request == given
    program = tmp_path / "refract"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m refract_core.cli "$@"\n')
    program.chmod(0o755)
    where = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PYTHONPATH": str(service_server.ROOT)}
    subprocess.run(["sh", "-c", command], cwd=samples, check=True, timeout=300, env={**os.environ, **where})
    serving = service_server.running(tmp_path / "data", "--stage-root", str(samples), "--workers", "1")
    with serving as server, server.client() as client:
        sent = client.post("/v1/render", json={"stage": "marble.usda", **request}, timeout=300)
    assert sent.status_code == 200
    picture = (samples / "marble.0003.png").read_bytes()
    assert sent.content == picture
    assert b"tEXtrefract:stage\0marble.usda" in chunks(picture)  # and nothing of where it lies
    (words,) = (one for one in chunks(picture) if b"refract:overrides" in one)
    assert b"/World/Amber.transmittanceColor=1.0,0.5,0.25 " in words


def test_events_come_whole_however_they_are_cut(module: Path) -> None:
    text = 'event: progress\ndata: {"a":\ndata: 1}\n\n: a comment\n\nevent: done\r\ndata: x: y\r\n\r\n'
    cut = """(() => {
        const all = [];
        let rest = "";
        for (const letter of text) {
            const [found, left] = page.parseEvents(rest + letter);
            all.push(...found);
            rest = left;
        }
        return all;
    })()"""
    expected = [{"event": "progress", "data": '{"a":\n1}'}, {"event": "done", "data": "x: y"}]
    assert js(module, cut, text=text) == expected


def test_false_colour_grows_lighter_from_end_to_end(module: Path) -> None:
    colours = js(module, "Array.from({length: 101}, (_, at) => page.falseColour(at / 100))")
    light = [luminance("#" + "".join(f"{channel:02x}" for channel in colour)) for colour in colours]
    assert all(one < two for one, two in pairwise(light))
    assert js(module, "[page.falseColour(-3), page.falseColour(9)]") == [colours[0], colours[-1]]


def test_the_picker_speaks_linear_light(module: Path) -> None:
    assert js(module, "page.linearOf('#ffffff')") == [1, 1, 1]
    assert js(module, "page.linearOf('#808080')") == pytest.approx([0.2159] * 3, abs=1e-4)  # IEC 61966-2-1
    colours = ["#000000", "#0b6e75", "#ff8001", "#123456"]
    assert js(module, "colours.map((one) => page.hexOf(page.linearOf(one)))", colours=colours) == colours


def test_pointers_are_read_as_rfc_6901_says(module: Path) -> None:
    pointers = ["/overrides/~1W~1a~0b/ior", "#/samples", ""]
    assert js(module, "p.map(page.pointerParts)", p=pointers) == [["overrides", "/W/a~b", "ior"], ["samples"], []]
