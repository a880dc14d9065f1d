"""The parts of the service one by one: limits, models, bodies, the check of a stage's files, the lock, the store."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import pytest
from pxr import UsdUtils
from service_server import ROOT, InProcess
from service_stages import HEAD, escapes, laughs, referring

from refract_core.errors import UsageError
from refract_core.images.aovs import AOVS
from refract_core.settings import INDIRECT, MODELS, PRESETS, PURPOSES, QUALITIES, SCREEN_METHODS, TIERS, RenderSettings
from service import confine, models, precheck, problems, tasks
from service.app import Settings, create_app
from service.bodies import check, parse
from service.digests import engine
from service.limits import Limits, limits_from, table
from service.problems import KINDS, Problem
from service.store import Record, Store

GOOD = ROOT / "usd_samples" / "good"


# --- limits


def test_the_environment_and_then_flags_set_limits() -> None:
    environment = {"REFRACT_LIMIT_SAMPLES": "8", "REFRACT_LIMIT_PIXELS": "100", "HOME": "/"}
    limits = limits_from({"samples": 4, "aovs": None}, environment)
    assert (limits.samples, limits.pixels, limits.aovs) == (4, 100, Limits().aovs)
    assert {row["name"]: row["value"] for row in table(limits)}["samples"] == 4


@pytest.mark.parametrize("environment", [{"REFRACT_LIMIT_NOPE": "1"}, {"REFRACT_LIMIT_SAMPLES": "x"},
                                         {"REFRACT_LIMIT_SAMPLES": "0"}])  # fmt: skip
def test_a_wrong_limit_is_a_wrong_usage(environment: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        limits_from({}, environment)


# --- models: the same words as the engine


def test_the_models_have_the_engines_words() -> None:
    assert get_args(models.Model) == MODELS
    assert get_args(models.Tier) == TIERS
    assert get_args(models.Purpose) == PURPOSES
    assert get_args(models.Aov) == tuple(AOVS)
    # Features are in aovs; HTTP sends no mattes and no parts of pictures, and reads no file of the server's.
    left_out = {"jobs", "tile_size", "features", "cryptomatte", "crop", "tile_count", "tile_index", "environment"}
    known = {one.name for one in fields(RenderSettings)} - left_out
    assert known <= models.Render.model_fields.keys()
    tokens = {"screen": SCREEN_METHODS, "quality": QUALITIES, "preset": PRESETS, "indirect": INDIRECT}
    for field, words in tokens.items():
        assert get_args(get_args(models.Render.model_fields[field].annotation)[0]) == tuple(words)


@pytest.mark.parametrize(
    ("settings", "pointer"),
    [
        ({"samples": True}, "/samples"), ({"samples": 1.0}, "/samples"), ({"samples": "4"}, "/samples"),
        ({"exposure": False}, "/exposure"), ({"exposure": float("inf")}, "/exposure"), ({"sample": 1}, "/sample"),
        ({"tiers": ["screen", "moon"]}, "/tiers/1"), ({"tiers": []}, "/tiers"), ({"camera": 7}, "/camera"),
        ({"camera": "a\0b"}, "/camera"), ({"overrides": {"/a/b": {"ior": 0.5}}}, "/overrides/~1a~1b/ior"),
        ({"overrides": {"/a": {"colour": 1}}}, "/overrides/~1a/colour"), ({"image_width": 0}, "/image_width"),
        ({"overrides": {"/a": {"transmittanceColor": [1, 1]}}}, "/overrides/~1a/transmittanceColor"),
        ({"indirect": "half"}, "/indirect"), ({"indirect": 1}, "/indirect"),
        ({"time_code": True}, "/time_code"), ([], ""), (None, ""), ("x", ""),
    ],
)  # fmt: skip
def test_models_are_strict_and_point_at_the_field(settings: Any, pointer: str) -> None:
    with pytest.raises(Problem) as caught:
        check(models.Render, settings)
    assert [one["pointer"] for one in caught.value.errors] == [pointer]


@pytest.mark.parametrize("wrong", [{"tolerance": -1}, {"tolerance": 2}, {"light_samples": 0}, {"light_samples": 5000}])
def test_a_number_out_of_range_is_told_both_ends_of_it(wrong: dict[str, float]) -> None:
    (name, value), = wrong.items()
    with pytest.raises(Problem) as of_service:
        check(models.Render, wrong)
    with pytest.raises(UsageError) as of_engine:
        RenderSettings(**{name: value})  # type: ignore[arg-type]
    low, high = (float(word) for word in str(of_engine.value).rpartition("between ")[2].split(" and "))
    told = of_service.value.errors[0]["detail"].removeprefix("must be between ").split(" and ")
    assert [float(word) for word in told] == [low, high]
    assert of_service.value.detail == f"/{name}: {of_service.value.errors[0]['detail']}"


def test_a_field_that_is_not_known_is_told_the_nearest_one() -> None:
    with pytest.raises(Problem) as caught:
        check(models.Render, {"tolerence": 0.1, "xyz": 1})
    assert [one["detail"].partition("; ")[2] for one in caught.value.errors] == [
        "did you mean tolerance?", "leave it out, or see /docs"
    ]  # fmt: skip
    assert caught.value.detail.endswith("; and 1 more")


def test_a_whole_number_is_a_number() -> None:
    assert check(models.Render, {"exposure": 1, "samples": 4}).model_dump(exclude_none=True) == {
        "exposure": 1.0, "samples": 4
    }  # fmt: skip


@pytest.mark.parametrize("text", ["", "{", '{"a": NaN}', "[Infinity]", "-Infinity", "[" * 100_000, "1" * 5000, b"\xff"])
def test_what_is_not_json_is_a_problem(text: str | bytes) -> None:
    with pytest.raises(Problem) as caught:
        parse(text)
    assert caught.value.slug == "bad-request"


# --- the check of a stage's files


@pytest.mark.parametrize("name", list(escapes("/x/y.usda")))
def test_every_way_out_is_refused_before_usd_composes(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.usda").write_text(escapes("/x/y.usda")[name])
    with pytest.raises(precheck.Refused):
        precheck.check_stage(str(tmp_path / "a.usda"), str(tmp_path), layers=10, unpacked_bytes=1000)


def test_a_link_that_leads_out_is_refused_and_one_inside_is_not(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "out.usda").write_text(HEAD)
    (root / "in.usda").write_text(HEAD)
    (root / "a.usda").write_text(referring("./link.usda"))
    (root / "link.usda").symlink_to("in.usda")
    precheck.check_stage(str(root / "a.usda"), str(root), layers=10, unpacked_bytes=1000)
    (root / "link.usda").unlink()
    (root / "link.usda").symlink_to(tmp_path / "out.usda")
    with pytest.raises(precheck.Refused):
        precheck.check_stage(str(root / "a.usda"), str(root), layers=10, unpacked_bytes=1000)


def test_too_many_layers_are_refused(tmp_path: Path) -> None:
    for index in range(5):
        (tmp_path / f"{index}.usda").write_text(referring(f"./{index + 1}.usda"))
    root = str(tmp_path)
    precheck.check_stage(str(tmp_path / "0.usda"), root, layers=6, unpacked_bytes=1000)
    with pytest.raises(precheck.TooMany):
        precheck.check_stage(str(tmp_path / "0.usda"), root, layers=3, unpacked_bytes=1000)


PAIRS = "".join(f'def "a{n}"\n{{\n    def "b"\n    {{\n    }}\n}}\n' for n in range(1100))
LADDER = 'def "N0"\n{\n}\ndef "N1"\n{\n}\n' + "".join(
    f'def "N{n}" (\n    references = [</N{n - 1}>, </N{n - 2}>]\n)\n{{\n}}\n' for n in range(2, 40)
)


@pytest.mark.parametrize(
    ("stage", "words"),
    [(laughs(30), "2147483616 prims; the limit is 1000"), (HEAD + PAIRS, "more prims than can be counted"),
     (HEAD + LADDER, "opinions; the limit is 1000 prims of 8")],
)  # fmt: skip
def test_too_many_prims_are_refused_with_their_number(tmp_path: Path, stage: str, words: str) -> None:
    (tmp_path / "a.usda").write_text(stage)
    with pytest.raises(precheck.TooMany, match=words):
        precheck.check_size(str(tmp_path / "a.usda"), 1000)
    precheck.check_size(str(GOOD / "marble.usda"), 1000)


def test_samples_and_their_packages_pass(tmp_path: Path) -> None:
    for path in sorted(GOOD.glob("*.usda")):
        precheck.check_stage(str(path), str(GOOD), layers=50, unpacked_bytes=1000)
    UsdUtils.CreateNewUsdzPackage(str(GOOD / "marble.usda"), str(tmp_path / "m.usdz"))
    precheck.check_stage(str(tmp_path / "m.usdz"), str(tmp_path), layers=50, unpacked_bytes=10_000_000)
    with pytest.raises(precheck.TooMany):
        precheck.check_stage(str(tmp_path / "m.usdz"), str(tmp_path), layers=50, unpacked_bytes=1000)


# --- the lock


@pytest.mark.skipif(not confine.landlock_abi() or not confine.available()["seccomp"], reason="this kernel has no lock")
def test_a_confined_process_reaches_nothing_but_its_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "secret").write_text("x")
    code = f"""
import ctypes, os, socket, sys, threading, resource
sys.path.insert(0, {str(ROOT)!r})
from service.confine import Means, confine
confine([sys.prefix, sys.base_prefix, "/usr/lib", "/lib"], [{str(tmp_path / "mine")!r}], Means(1 << 30, 5, 1000, 64))
def tried(what):
    try: what(); return "done"
    except (OSError, MemoryError, ValueError) as error: return type(error).__name__
def big():
    with open({str(tmp_path / "mine" / "big")!r}, "wb") as file: file.write(b"x" * 2000); file.flush()
def thread():
    one = threading.Thread(target=lambda: None); one.start(); one.join()
print(tried(lambda: open({str(tmp_path / "mine" / "a")!r}, "w").close()), tried(thread),
      tried(lambda: open({str(tmp_path / "other" / "secret")!r})), tried(lambda: os.listdir("/etc")),
      tried(lambda: open({str(tmp_path / "other" / "new")!r}, "w")), tried(socket.socket), tried(os.fork),
      tried(lambda: os.execv("/bin/true", ["true"])), tried(lambda: os.kill(os.getppid(), 0)), tried(big),
      tried(lambda: bytearray(2 << 30)), tried(lambda: resource.setrlimit(resource.RLIMIT_AS, (-1, -1)) or 0))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    words = done.stdout.split()
    assert words[:2] == ["done", "done"], done.stderr
    assert words[2:9] == ["PermissionError"] * 7
    assert words[9:] == ["OSError", "MemoryError", "ValueError"]  # the last tries to raise its own limit again
    assert (tmp_path / "mine" / "a").exists()


# --- the store


def test_a_record_survives_and_an_orphan_has_failed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    done = Record("a" * 64, "render", {"format": "png"}, "x.usda", False, status="done")
    left = Record("b" * 64, "inspect", {}, "stage.usda", True, status="running")
    for record in (done, left):
        store.save(record)
    (store.folder(left.id) / "stage.usda").write_text("theirs")
    (store.jobs / "rubbish").mkdir()
    found = Store(tmp_path).load_all()
    assert found[done.id] == done
    assert found[left.id].problem is not None
    assert found[left.id].status == "failed"
    assert not (store.folder(left.id) / "stage.usda").exists()
    assert not (store.jobs / "rubbish").exists()


def test_only_plain_files_of_known_names_are_taken(tmp_path: Path) -> None:
    store = Store(tmp_path)
    record = Record("a" * 64, "render", {}, "x.usda", False)
    store.save(record)
    work = store.new_work()
    (work / "out" / "image.png").symlink_to("/etc/passwd")
    (work / "out" / "record.json").write_text("{}")
    (work / "out" / "aov.Z.png").write_text("picture")
    store.take_results(work, record)
    assert sorted(path.name for path in store.folder(record.id).iterdir()) == ["aov.Z.png", "record.json"]
    assert json.loads((store.folder(record.id) / "record.json").read_text())["id"] == record.id


# --- the app without workers


@pytest.fixture
def client(tmp_path: Path) -> InProcess:
    app = create_app(Settings(stage_root=str(GOOD), data=str(tmp_path / "data")))

    @app.get("/broken")
    async def broken() -> None:
        raise RuntimeError("secret /path")

    return InProcess(app)


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/nothing", 404), ("PUT", "/v1/render", 405), ("GET", "/v1/render", 405), ("GET", "/v1/jobs/x", 404),
     ("GET", "/v1/jobs/x/aovs/..%2F..%2Frecord.png", 404), ("POST", "/v1/render", 415), ("GET", "/broken", 500),
     ("GET", "/readyz", 503), ("GET", "/static/../app.py", 404), ("GET", "/problems/none", 404)],
)  # fmt: skip
def test_every_error_is_a_problem_document(client: InProcess, method: str, path: str, status: int) -> None:
    answer = client.request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert document["status"] == status
    assert document["type"].removeprefix("/problems/") in KINDS
    assert "secret" not in answer.text
    assert client.get(document["type"]).status_code == 200


@pytest.mark.parametrize("body", [b"{", b"[]", b'{"samples": NaN, "stage": "marble.usda"}', b'"x"'])
def test_no_body_makes_the_service_fail(client: InProcess, body: bytes) -> None:
    answer = client.post("/v1/render", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422)
    assert "NaN" not in answer.text


@pytest.mark.parametrize("parts", [{}, {"stage": ("a", b"no usd")}, {"other": ("a", b"#usda 1.0")}])
def test_a_wrong_form_is_a_problem(client: InProcess, parts: dict[str, Any]) -> None:
    answer = client.post("/v1/render", files=parts, data={"settings": "{}"})
    assert answer.status_code in (415, 422)
    assert answer.headers["content-type"] == "application/problem+json"


def test_another_sites_page_may_not_ask_for_work(client: InProcess) -> None:
    body = {"stage": "marble.usda", "samples": 100_000}
    theirs = client.post("/v1/render", json=body, headers={"Origin": "https://example.com"})
    assert theirs.json()["type"] == "/problems/cross-origin"
    assert client.post("/v1/render", json=body, headers={"Origin": "http://localhost"}).status_code == 422


def test_pages_load_nothing_from_elsewhere(client: InProcess) -> None:
    for path in ("/docs", "/problems/too-large", "/"):
        answer = client.get(path)
        assert answer.status_code == 200
        assert 'src="http' not in answer.text
        assert 'rel="stylesheet" href="http' not in answer.text


def test_the_openapi_document_names_every_route(client: InProcess) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    for path in ("/v1/render", "/v1/convert", "/v1/bake-probes", "/v1/bake-thickness", "/v1/inspect", "/v1/validate",
                 "/v1/jobs/{identifier}", "/v1/stages", "/v1/limits", "/livez", "/readyz", "/metrics"):  # fmt: skip
        assert path in paths
    form = paths["/v1/render"]["post"]["requestBody"]["content"]
    assert form["application/json"]["schema"]["additionalProperties"] is False
    assert "samples" in form["application/json"]["schema"]["properties"]


@pytest.mark.parametrize("tokens", [(), ("a-token-of-the-tests",)])
def test_the_openapi_document_tells_where_a_token_is_asked_for(tmp_path: Path, tokens: tuple[str, ...]) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), tokens=tokens)))
    document = client.get("/openapi.json").json()  # open to all, as are the pages
    schemes = document["components"].get("securitySchemes", {})
    assert schemes == ({"token": {"type": "http", "scheme": "bearer"}} if tokens else {})
    for path, operations in document["paths"].items():
        asks = bool(tokens) and path.startswith(("/v1/", "/metrics"))
        for operation in operations.values():
            assert operation.get("security", []) == ([{"token": []}] if asks else [])
            assert ("401" in operation["responses"]) == asks
    assert client.get("/").status_code == client.get("/static/page.js").status_code == 200
    assert client.get("/v1/stages").status_code == (401 if tokens else 200)
    if tokens:
        assert client.get("/v1/limits").headers["www-authenticate"] == "Bearer"
    limits = client.get("/docs").text.partition('id="limits"')[2]  # where the page's link leads, with tokens or not
    assert all(str(row["name"]) in limits for row in table(Limits()))
    assert 'href="docs#limits"' in client.get("/").text


def test_the_openapi_document_tells_what_is_refused(client: InProcess) -> None:
    document = client.get("/openapi.json").json()
    for verb in ("render", "convert", "bake-probes", "bake-thickness", "inspect", "validate"):
        body = document["paths"][f"/v1/{verb}"]["post"]["requestBody"]["content"]
        named = body["application/json"]["schema"]
        assert named["required"] == ["stage"]
        assert named["properties"]["stage"]["type"] == "string"
        uploaded = body["multipart/form-data"]["schema"]["properties"]["settings"]["contentSchema"]
        assert uploaded["properties"].keys() == named["properties"].keys()
        assert "required" not in uploaded
    operations = [one for path in document["paths"].values() for one in path.values()]
    every = [answer for one in operations for answer in one["responses"].items()]
    for status, answer in every:
        assert ("application/problem+json" in answer.get("content", {})) == (status >= "400")
    statuses = {int(status) for status, _ in every}
    # No tokens here; and a method that is not allowed is no operation.
    assert {kind.status for kind in KINDS.values()} - statuses == {401, 405}


def test_the_openapi_document_sorts_its_operations_and_its_examples_are_right(client: InProcess) -> None:
    document = client.get("/openapi.json").json()
    known = [tag["name"] for tag in document["tags"]]
    assert all(one["tags"] and set(one["tags"]) <= set(known) for path in document["paths"].values()
               for one in path.values())  # fmt: skip
    assert document["servers"][0]["url"] == "/"
    for verb, model in models.KINDS.items():
        content = document["paths"][f"/v1/{verb}"]["post"]["requestBody"]["content"]["application/json"]
        assert content["examples"]
        for example in content["examples"].values():
            assert (GOOD / str(check(model, example["value"]).stage)).is_file()
    operations = [one for path in document["paths"].values() for one in path.values()]
    for status, answer in (pair for one in operations for pair in one["responses"].items()):
        if "application/problem+json" in answer.get("content", {}):
            assert answer["content"]["application/problem+json"]["example"]["status"] == int(status)


@pytest.mark.parametrize(("path", "methods"), [("/v1/render", "POST"), ("/v1/jobs/x", "DELETE, GET, HEAD"),
                                               ("/livez", "GET, HEAD"), ("/static/page.js", "GET, HEAD"),
                                               ("/openapi.json", "GET, HEAD")])  # fmt: skip
def test_a_wrong_method_is_told_the_right_ones(client: InProcess, path: str, methods: str) -> None:
    answer = client.request("PUT", path)
    assert (answer.status_code, answer.headers["allow"]) == (405, methods)


def test_settings_are_checked() -> None:
    for wrong in ({"workers": 0}, {"queue": -1}, {"stage_root": "/nowhere/at/all"}, {"tokens": ("short",)}):
        with pytest.raises(UsageError):
            Settings(**wrong)


def test_the_engine_has_one_name() -> None:
    assert engine() == engine()
    assert {kind.status for kind in problems.KINDS.values()} >= {400, 401, 404, 405, 413, 415, 422, 429, 500, 503}
    assert socket.AF_UNIX  # workers are spoken to through such sockets


@pytest.mark.parametrize("text", [
    "USD's own validators gave up: x.usdz[0/a.usda]:236:9: Expected } at 'def Material \"Wall\"' in </Looks>",
    "the layer is damaged: x.usda:12:3: Unexpected token 'def Material \"Wall\"'",
    "Could not open asset @x.usda@ for reference introduced by @y.usda@</A> -- :236:9: Expected } at 'def Material'",
])  # fmt: skip
def test_what_usd_quotes_from_a_file_stays_here(text: str) -> None:
    said = tasks._public(text)
    assert said
    assert "Material" not in said
