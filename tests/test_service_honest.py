"""What an honest client meets: places of errors, large textures, pictures with planes, stages of several files."""

from __future__ import annotations

import base64
import io
import json
import stat
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image
from service_server import BALL, PATIENT, ROOT, SMALL, Server, running, upload
from service_stages import HEAD, package, referring

from refract_core.images.codec import encoded, exr_spec
from refract_core.images.pictures import read_planes, read_texture
from refract_core.verbs.convert import ConvertOrder, convert
from service.formats import FORMATS
from service.limits import Limits

pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    data = tmp_path_factory.mktemp("honest") / "data"
    with running(data, "--stage-root", str(GOOD), "--workers", "1", *PATIENT) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client


def render(client: httpx.Client, files: Any, accept: str = "image/png", **settings: Any) -> httpx.Response:
    data = {"settings": json.dumps({**SMALL, **settings})}
    return client.post("/v1/render", files=files, data=data, headers={"Accept": accept})


def warnings(client: httpx.Client, answer: httpx.Response) -> list[str]:
    assert answer.status_code == 200, answer.text
    return [one["text"] for one in client.get(answer.headers["content-location"]).json()["warnings"]]


def pixels(answer: httpx.Response) -> Any:
    assert answer.status_code == 200, answer.text
    if answer.headers["content-type"] == "image/avif":
        return np.asarray(Image.open(io.BytesIO(answer.content)))
    return read_texture(answer.content, name="picture", color_space="raw").pixels


# --- errors of syntax


def test_an_error_of_syntax_is_told_by_line_and_column(client: httpx.Client) -> None:
    lines = [*HEAD.splitlines(), 'def Sphere "World"', "{", "    double radius = = 1", "}"]
    detail = render(client, upload("\n".join(lines))).json()["detail"]
    line = 1 + lines.index("    double radius = = 1")
    assert detail == f"stage.usda: cannot be read as USD: line {line}, column 5: expected }}"
    assert "radius" not in detail


def test_an_error_of_syntax_in_a_part_is_told_by_line_and_column(client: httpx.Client) -> None:
    broken = f'{HEAD}def Sphere "World"\n{{\n    color3f[] x = [(1, 2]\n}}\n'
    answer = render(client, upload(package({"a.usda": referring("b.usda"), "b.usda": broken})))
    (told,) = [text for text in warnings(client, answer) if "b.usda" in text]
    assert f"line {len(HEAD.splitlines()) + 3}, column 25" in told
    assert "(1, 2]" not in told


# --- pictures


def test_a_texture_as_large_as_the_limit_is_drawn(client: httpx.Client) -> None:
    side = 8192
    assert side * side == Limits().texture_pixels
    spec = exr_spec(side, side, "RGB", ["half"] * 3, {})
    picture = encoded("light.exr", np.full((side, side, 3), 0.25, np.float32), spec)
    sky = 'def DomeLight "Sky"\n    {\n        asset inputs:texture:file = @sky.exr@\n    }\n    def Material "Glass"'
    files = package({"a.usda": BALL.replace('def Material "Glass"', sky), "sky.exr": picture})
    assert not [text for text in warnings(client, render(client, upload(files))) if "sky" in text]
    surface = textured("wall.exr")
    files = package({"a.usda": surface, "wall.exr": picture})
    assert not [text for text in warnings(client, render(client, upload(files))) if "wall" in text]


def textured(picture: str) -> str:
    """A square that wears a picture."""
    return f"""{HEAD}def Xform "World"
{{
    def Mesh "Wall" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        rel material:binding = </World/Paint>
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
        uniform token subdivisionScheme = "none"
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (
            interpolation = "vertex"
        )
    }}
    def Material "Paint"
    {{
        token outputs:surface.connect = </World/Paint/Surface.outputs:surface>
        def Shader "Surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </World/Paint/Picture.outputs:rgb>
            token outputs:surface
        }}
        def Shader "Picture"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{picture}@
            float2 inputs:st.connect = </World/Paint/Reader.outputs:result>
            float3 outputs:rgb
        }}
        def Shader "Reader"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
}}
"""


def test_an_exr_with_planes_holds_the_picture_too(client: httpx.Client, tmp_path: Path) -> None:
    (tmp_path / "plain.exr").write_bytes(render(client, upload(BALL), "image/x-exr").content)
    (tmp_path / "planes.exr").write_bytes(render(client, upload(BALL), "image/x-exr", aovs=["N", "thickness"]).content)
    planes = read_planes(str(tmp_path / "planes.exr"))
    assert planes.keys() == {"beauty", "N", "thickness"}
    np.testing.assert_array_equal(planes["beauty"], read_planes(str(tmp_path / "plain.exr"))["beauty"])


# --- stages of several files


def tree() -> dict[str, bytes]:
    """A stage one folder down, a layer beside it, a picture beside that folder; every reference stays inside."""
    wall = textured("../textures/wall.png")
    shot = referring("../parts/wall.usda")
    return {"shots/shot.usda": shot.encode(), "parts/wall.usda": wall.encode(),
            "textures/wall.png": (GOOD / "textures" / "wood.png").read_bytes()}  # fmt: skip


def whole(client: httpx.Client, answer: httpx.Response) -> bytes:
    """The picture, if nothing was missing."""
    assert not [text for text in warnings(client, answer) if "wall" in text or "missing" in text]
    return answer.content


def test_several_files_are_one_stage(client: httpx.Client) -> None:
    files = tree()
    parts = [("file", (name, content)) for name, content in files.items() if name != "shots/shot.usda"]
    first = render(client, [("stage", ("shots/shot.usda", files["shots/shot.usda"])), *parts])
    picture = whole(client, first)
    every = [("file", (name, content)) for name, content in reversed(files.items())]
    named = render(client, every, stage="shots/shot.usda")
    assert whole(client, named) == picture
    assert named.headers["etag"] == first.headers["etag"]  # the same files, whatever their order
    ambiguous = render(client, every).json()  # a stage in each of two folders
    assert "parts/wall.usda, shots/shot.usda" in ambiguous["detail"]
    alone = render(client, [("stage", ("shots/shot.usda", files["shots/shot.usda"]))])
    assert alone.json()["type"] == "/problems/stage-refused"  # one file has no place beside it


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_zip_is_one_stage(client: httpx.Client, method: int) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in tree().items():
            archive.writestr(f"scene/{name}", content)
    files = {"stage": ("scene.zip", stream.getvalue())}
    picture = whole(client, render(client, files, stage="scene/shots/shot.usda"))
    parts = [("file", (name, content)) for name, content in tree().items()]
    assert whole(client, render(client, parts, stage="shots/shot.usda")) == picture
    for verb in ("inspect", "validate", "convert"):
        settings = json.dumps({"stage": "scene/shots/shot.usda"})
        answer = client.post(f"/v1/{verb}", files=files, data={"settings": settings})
        assert answer.status_code == 200, answer.text
    inside = zipfile.ZipFile(io.BytesIO(answer.content)).namelist()
    assert any(name.endswith(".png") for name in inside)  # the converted package is whole


def test_as_many_files_as_are_allowed_fit_into_the_folder_of_a_job(client: httpx.Client) -> None:
    """Each in a folder of its own: nearly twice as many as a job may have beside its upload."""
    stream, limits = io.BytesIO(), Limits()
    count = limits.upload_files - 1
    assert 2 * count > limits.folder_files
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.usda", BALL)
        for number in range(count):
            archive.writestr(f"{number}/x.bin", bytes(60_000))
    assert render(client, {"stage": ("a.zip", stream.getvalue())}).status_code == 200


@pytest.mark.parametrize("reference", ["../../../x.usda", "/etc/passwd", "../x.usda"])
def test_nothing_leaves_the_folder_of_an_upload(client: httpx.Client, reference: str) -> None:
    parts = [("file", ("a.usda", referring(reference).encode())), ("file", ("b/c.usda", BALL.encode()))]
    refused = render(client, parts, stage="a.usda")
    assert refused.json()["type"] == "/problems/stage-refused"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        link = zipfile.ZipInfo("x.usda")
        link.external_attr, link.create_system = (stat.S_IFLNK | 0o777) << 16, 3
        archive.writestr("a.usda", referring("./x.usda"))
        archive.writestr(link, "/etc/passwd")
    linked = render(client, {"stage": ("a.zip", stream.getvalue())})
    assert linked.json()["type"] == "/problems/stage-refused"
    assert "x.usda" in linked.json()["detail"]


# --- glTF


def test_gltf_is_converted_and_drawn(client: httpx.Client, tmp_path: Path) -> None:
    document, content = ball_of_glass()
    (tmp_path / "ball.gltf").write_text(json.dumps(document))
    (tmp_path / "ball points.bin").write_bytes(content)
    convert(ConvertOrder(stage=str(tmp_path / "ball.gltf"), out=str(tmp_path / "ball.usdz")))
    expected = render(client, upload((tmp_path / "ball.usdz").read_bytes()))
    parts = [("stage", ("ball.gltf", json.dumps(document).encode())), ("file", ("ball points.bin", content))]
    drawn = render(client, parts)
    assert drawn.status_code == 200, drawn.text
    np.testing.assert_array_equal(pixels(drawn), pixels(expected))
    single = json.loads(json.dumps(document))
    single["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    np.testing.assert_array_equal(pixels(render(client, upload(json.dumps(single), "ball.gltf"))), pixels(expected))
    del single["buffers"][0]["uri"]
    glb = {"stage": ("ball.glb", binary(single, content))}
    np.testing.assert_array_equal(pixels(render(client, glb)), pixels(expected))
    assert client.post("/v1/inspect", files=glb).json()["prims"]["meshes"] == 1
    report = client.post("/v1/convert", files=glb, headers={"Accept": "application/json"}).json()
    assert [row["shader"] for row in report["materials"]] == ["KHR_materials_transmission"]
    broken = render(client, {"stage": ("a.glb", b"glTF" + bytes(40))})
    assert broken.json()["type"] == "/problems/stage-invalid"
    gone = render(client, upload(json.dumps(document), "ball.gltf"))
    assert "ball%20points.bin" in gone.json()["detail"]


def ball_of_glass() -> tuple[dict[str, Any], bytes]:
    """An octahedron of glass as glTF, and its buffer."""
    points = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], np.float32)
    corners = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)], "u2")
    content = points.tobytes() + corners.tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 6, "type": "VEC3", "min": [-1] * 3, "max": [1] * 3},
        {"bufferView": 1, "componentType": 5123, "count": 24, "type": "SCALAR"},
    ]
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
             {"buffer": 0, "byteOffset": points.nbytes, "byteLength": corners.nbytes}]  # fmt: skip
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1.0}},
                       "pbrMetallicRoughness": {"metallicFactor": 0.0}}],  # without it, it is metal
        "extensionsUsed": ["KHR_materials_transmission"], "accessors": accessors, "bufferViews": views,
        "buffers": [{"uri": "ball%20points.bin", "byteLength": len(content)}],
    }  # fmt: skip
    return document, content


def binary(document: dict[str, Any], content: bytes) -> bytes:
    """The same as one .glb."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(content), 0x004E4942) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


# --- formats


STARTS = {"png": b"\x89PNG", "jpeg": b"\xff\xd8\xff", "webp": b"RIFF", "avif": b"\0\0\0 ftypavif",
          "exr": b"\x76\x2f\x31\x01"}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_chosen_by_accept_and_by_name(client: httpx.Client, name: str) -> None:
    media = FORMATS[name].media
    by_header, by_name = render(client, upload(BALL), media), render(client, upload(BALL), "*/*", format=name)
    assert by_header.headers["content-type"] == by_name.headers["content-type"] == media, by_header.text
    assert by_header.content == by_name.content
    assert by_header.headers["etag"] == by_name.headers["etag"]
    assert by_header.content.startswith(STARTS[name])
    image = client.get(f"{by_name.headers['content-location']}/image")
    assert (image.headers["content-type"], image.content) == (media, by_name.content)
    if name != "exr":  # which is linear
        seen, plain = (over_black(pixels(one)) for one in (by_name, render(client, upload(BALL))))
        assert np.abs(seen - plain).mean() < 0.02  # compression that an eye does not see


def test_a_browser_gets_what_it_likes_best(client: httpx.Client) -> None:
    browser = render(client, upload(BALL), "image/avif,image/webp,*/*;q=0.8")
    assert browser.headers["content-type"] == "image/avif"
    assert render(client, upload(BALL), "image/jpeg", format="png").status_code == 406


def over_black(rgba: Any) -> Any:
    """Colours, shape (H, W, 3), in [0, 1]: where a picture is transparent they may be anything."""
    alpha = rgba[..., 3:] / 255.0 if rgba.shape[-1] == 4 else 1.0  # some readers leave out one that is full
    return rgba[..., :3] / 255.0 * alpha


# --- several pictures in one job


def test_several_widths_and_times_are_one_job(client: httpx.Client) -> None:
    stage = BALL.replace("double radius = 1", "double radius.timeSamples = { 0: 1, 1: 0.5 }")
    wanted = {"widths": [16, 32], "time_codes": [0, 1], "samples": 1}
    data = {"settings": json.dumps({**wanted, "format": "png"})}
    answer = client.post("/v1/render", files=upload(stage), data=data)
    assert answer.headers["content-type"] == "application/zip", answer.text
    where = answer.headers["content-location"]
    job = client.get(where).json()
    assert [(one["width"], one["time_code"]) for one in job["pictures"]] == [(16, 0), (32, 0), (16, 1), (32, 1)]
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert len(archive.namelist()) == 4
    assert client.get(job["links"]["pictures"]).content == answer.content
    for one, name in zip(job["pictures"], archive.namelist(), strict=True):
        single = render(client, upload(stage), image_width=one["width"], time_code=one["time_code"])
        several = client.get(one["href"])
        np.testing.assert_array_equal(pixels(several), pixels(single))
        assert archive.read(name) == several.content
        assert f"{one['width']}x{one['height']}" in name
    assert client.get(f"{where}/image").content == client.get(job["pictures"][0]["href"]).content
    assert client.get(f"{where}/pictures/4").status_code == client.get(f"{where}/pictures/x").status_code == 404


@pytest.mark.parametrize(("settings", "pointer"), [
    ({"widths": [16, 32], "image_width": 16}, "/image_width"), ({"time_codes": [0], "time_code": 0}, "/time_code"),
    ({"widths": [16, 16]}, "/widths"), ({"widths": list(range(1, 60)), "time_codes": [0, 1]}, "/time_codes"),
    ({"widths": [16, 32], "aovs": ["N"]}, "/aovs"), ({"widths": [1 << 23]}, "/widths"),
])  # fmt: skip
def test_several_pictures_are_asked_for_in_one_way(client: httpx.Client, settings: Any, pointer: str) -> None:
    answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(settings)})
    assert answer.status_code == 422
    assert [one["pointer"] for one in answer.json()["errors"]] == [pointer]


def test_pixels_of_all_pictures_count_together(client: httpx.Client) -> None:
    settings = {"widths": [1900, 1901], "samples": 64, "camera_light": True, "time_codes": list(range(20))}
    answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(settings)})
    assert answer.json()["type"] == "/problems/limit-exceeded"
    assert "pixel_samples" in answer.json()["detail"]


# --- variants


def test_a_variant_is_chosen_over_the_stages_own(client: httpx.Client) -> None:
    size = '"{name}" {{\n            over "Ball"\n            {{\n                double radius = {radius}\n'
    size += "            }}\n        }}"
    head = '''def Xform "World" (
    variants = {
        string size = "large"
    }
    prepend variantSets = "size"
)
{'''
    sets = "\n".join(size.format(name=name, radius=radius) for name, radius in (("large", 1), ("small", 0.5)))
    stage = BALL.replace("        double radius = 1\n", "").replace('def Xform "World"\n{', head)
    stage = stage.rstrip().removesuffix("}") + f'    variantSet "size" = {{\n        {sets}\n    }}\n}}\n'
    plain = pixels(render(client, upload(stage)))
    np.testing.assert_array_equal(pixels(render(client, upload(stage), variants=["/World{size=large}"])), plain)
    small = pixels(render(client, upload(stage), variants=["{size=small}"]))
    assert (small != plain).any()
    expected = pixels(render(client, upload(BALL.replace("radius = 1", "radius = 0.5"))))
    np.testing.assert_array_equal(small, expected)
    for wrong in ("/World{size=huge}", "/World{paint=red}", "/Nowhere{size=small}"):
        problem = render(client, upload(stage), variants=[wrong]).json()
        assert problem["errors"][0]["pointer"] == "/variants"
