"""What an honest client meets: places of errors, large textures, pictures with planes, stages of several files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from service_server import BALL, PATIENT, ROOT, SMALL, Server, running, upload
from service_stages import HEAD, package, referring

from refract_core.images.codec import encoded, exr_spec
from refract_core.images.pictures import read_planes
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
    light = np.full((side, side, 3), 0.25, np.float32)
    spec = exr_spec(side, side, "RGB", ["half"] * 3, {})
    sky = 'def DomeLight "Sky"\n    {\n        asset inputs:texture:file = @sky.exr@\n    }\n    def Material "Glass"'
    files = package({"a.usda": BALL.replace('def Material "Glass"', sky), "sky.exr": encoded("sky.exr", light, spec)})
    assert not [text for text in warnings(client, render(client, upload(files))) if "sky" in text]
    surface = textured("wall.exr")
    files = package({"a.usda": surface, "wall.exr": encoded("wall.exr", light, spec)})
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
