"""Files and requests that mean no good cost one job, and say why; nothing else is lost, and nothing is read."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from pxr import Sdf, UsdUtils
from service_server import BALL, PATIENT, ROOT, SMALL, Server, running, upload
from service_stages import HEAD, escapes, laughs, mutated, nested, package, referring

from refract_core.images.pictures import write_map

pytestmark = pytest.mark.slow
WAYS = [(name, "render") for name in escapes("/x/y.usda")]
WAYS += [("absolute", verb) for verb in ("inspect", "validate", "convert")]
WORD = "Xyzzy"
"""Stands in the file that no stage may read."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "secret.usda").write_text(f'{HEAD}def Sphere "World"\n{{\n    string {WORD} = "{WORD}"\n}}\n')
    (folder / "root").mkdir()
    (folder / "root" / "link.usda").symlink_to(folder / "secret.usda")
    (folder / "root" / "through.usda").write_text(referring("./inside.usda"))
    (folder / "root" / "inside.usda").symlink_to(folder / "secret.usda")
    (folder / "root" / "found.usda").write_text(referring("secret.usda"))
    # By the clock, honest stages too would end where the cores are busy.
    words = ("--workers", "1", "--stage-root", str(folder / "root"), *PATIENT, "--limit",
             "memory_bytes=2000000000", "--limit", "texture_pixels=1000000", "--limit", "triangles=100000")  # fmt: skip
    with running(folder / "data", *words) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    """After each test, an honest stage is still rendered."""
    with server.client() as client:
        yield client
        assert send(client, BALL).status_code == 200


def send(client: httpx.Client, stage: bytes | str, verb: str = "render") -> httpx.Response:
    settings = json.dumps(SMALL if verb == "render" else {})
    answer = client.post(f"/v1/{verb}", files=upload(stage), data={"settings": settings})
    assert answer.status_code < 500
    assert WORD not in answer.text
    return answer


def slug(answer: httpx.Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json", answer.text[:200]
    document = answer.json()
    assert document["status"] == answer.status_code
    return str(document["type"]).removeprefix("/problems/")


@pytest.mark.parametrize(("name", "verb"), WAYS)
def test_no_stage_reaches_out_of_its_folder(client: httpx.Client, server: Server, name: str, verb: str) -> None:
    stage = escapes(str(server.data.parent / "secret.usda"))[name]
    assert slug(send(client, stage, verb)) == "stage-refused"


@pytest.mark.parametrize("reference", ["{secret}", "../../../x.usda", "sub/b.usda"])
def test_no_package_reaches_out(client: httpx.Client, server: Server, reference: str) -> None:
    secret = str(server.data.parent / "secret.usda")
    files: dict[str, str | bytes] = {
        "a.usda": referring(reference.format(secret=secret)), "sub/b.usda": referring(secret)
    }  # fmt: skip
    assert slug(send(client, package(files))) == "stage-refused"


def test_an_honest_package_of_layers_is_drawn(client: httpx.Client) -> None:
    good = package({"a.usda": referring("sub/b.usda"), "sub/b.usda": referring("../c.usda"), "c.usda": BALL})
    assert send(client, good).status_code == 200


@pytest.mark.parametrize("name", ["/etc/x.usda", "../../x.usda"])
def test_a_package_with_names_outside_itself_is_refused(client: httpx.Client, name: str) -> None:
    assert slug(send(client, package({"a.usda": BALL, name: BALL}))) == "stage-refused"


_OUT = ["link.usda", "../secret.usda", "/etc/passwd", "through.usda", "root/../../secret.usda"]


@pytest.mark.parametrize("name", _OUT)
def test_no_name_of_a_stage_leads_out_of_the_stage_root(client: httpx.Client, name: str) -> None:
    answer = client.post("/v1/render", json={"stage": name, **SMALL})
    assert slug(answer) in ("invalid-settings", "stage-refused")
    assert WORD not in answer.text


def test_a_name_is_not_searched_for_elsewhere(client: httpx.Client) -> None:
    answer = client.post("/v1/inspect", json={"stage": "found.usda"})  # secret.usda lies one folder above
    assert answer.json()["prims"]["meshes"] == 0
    assert WORD not in answer.text


def test_bombs_end_at_a_limit(client: httpx.Client) -> None:
    assert slug(send(client, laughs(30))) == "limit-exceeded"
    assert slug(send(client, laughs(30, instanceable=True))) == "limit-exceeded"


def test_depth_crashes_one_worker_alone(client: httpx.Client, server: Server) -> None:
    before = server.metric("refract_worker_crashes_total")
    assert slug(send(client, nested(100_000))) == "stage-crashed"
    assert server.metric("refract_worker_crashes_total") == before + 1.0


def test_a_small_file_of_a_huge_array_ends_at_the_limit_of_memory(client: httpx.Client, tmp_path: Path) -> None:
    layer = Sdf.Layer.CreateNew(str(tmp_path / "a.usdc"))
    mesh = Sdf.PrimSpec(layer, "World", Sdf.SpecifierDef, "PointInstancer")
    ids = Sdf.AttributeSpec(mesh, "protoIndices", Sdf.ValueTypeNames.IntArray)
    ids.default = np.zeros(100_000_000, np.int32)
    points = Sdf.AttributeSpec(mesh, "positions", Sdf.ValueTypeNames.Float3Array)
    points.default = np.zeros((30_000_000, 3), np.float32)
    layer.Save()
    content = (tmp_path / "a.usdc").read_bytes()
    answer = send(client, content)
    assert answer.status_code in (200, 413, 422)


def test_too_many_triangles_are_refused(client: httpx.Client) -> None:
    quads = 60_000
    counts, corners = ", ".join(["4"] * quads), ", ".join(["0, 1, 2, 3"] * quads)
    mesh = (f'{HEAD}def Mesh "World"\n{{\n    int[] faceVertexCounts = [{counts}]\n    int[] faceVertexIndices = '
            f'[{corners}]\n    point3f[] points = [(0,0,0), (1,0,0), (1,1,0), (0,1,0)]\n}}\n')  # fmt: skip
    assert slug(send(client, mesh)) == "limit-exceeded"


def test_a_texture_beyond_the_limit_is_left_out(client: httpx.Client, tmp_path: Path) -> None:
    write_map(str(tmp_path / "big.exr"), np.zeros((2000, 1000), np.float32), {})
    sky = 'def DomeLight "Sky"\n    {\n        asset inputs:texture:file = @big.exr@\n    }\n'
    stage = BALL.replace('def Material "Glass"', f'{sky}    def Material "Glass"')
    sent = package({"a.usda": stage, "big.exr": (tmp_path / "big.exr").read_bytes()})
    answer = client.post("/v1/render", files=upload(sent), data={"settings": json.dumps(SMALL)})
    assert answer.status_code in (200, 422)
    warnings = client.get(answer.headers["content-location"]).json()["warnings"]
    assert any("1000000" in warning["text"] for warning in warnings), (answer.text[:300], warnings)


def test_settings_cannot_raise_a_limit(client: httpx.Client) -> None:
    for settings in ({"samples": 65}, {"image_width": 4096, "image_height": 4096}, {"image_width": 1 << 20}):
        answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(settings)})
        assert slug(answer) == "limit-exceeded"


def damaged(count: int, tmp_path: Path) -> Iterator[bytes]:
    """`count` files, a third each of text, crate and package, all with a known seed."""
    source = ROOT / "usd_samples" / "good" / "marble.usda"
    Sdf.Layer.FindOrOpen(str(source)).Export(str(tmp_path / "a.usdc"))
    UsdUtils.CreateNewUsdzPackage(str(source), str(tmp_path / "a.usdz"))
    contents = [BALL.encode(), (tmp_path / "a.usdc").read_bytes(), (tmp_path / "a.usdz").read_bytes()]
    for seed in range(count):
        yield mutated(contents[seed % 3], seed)


def test_damaged_files_are_answered(client: httpx.Client, tmp_path: Path) -> None:
    known = {"stage-invalid", "stage-refused", "stage-crashed", "time-limit", "memory-limit", "limit-exceeded"}
    outcomes: list[str] = []
    for content in damaged(40, tmp_path):
        answer = send(client, content, "inspect" if len(outcomes) % 4 == 3 else "render")
        outcomes.append("drawn" if answer.status_code == 200 else slug(answer))
    assert set(outcomes) <= known | {"drawn"}
    assert len(set(outcomes)) > 1  # some are damaged, some are not
