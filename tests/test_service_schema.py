"""The OpenAPI document is true: requests made from it, good and bad, are answered as it says."""

from __future__ import annotations

import json
import random
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any

import pytest
from service_server import BALL, PATIENCE, PATIENT, ROOT, SMALL, Server, running, upload

schemathesis = pytest.importorskip("schemathesis")

from schemathesis import config as options  # noqa: E402
from schemathesis.engine import events, from_schema  # noqa: E402

pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"
WORK = ("render", "convert", "bake-probes", "bake-thickness", "inspect", "validate")
TOKEN = "a-token-of-the-tests"
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}
EXAMPLES = 25
"""Random requests per operation, beside some hundred that each break one rule of the document."""
CHECKS: dict[str, Any] = {
    # DELETE cancels a job. The job stays, and tells that it was cancelled.
    "use_after_free": options.SimpleCheckConfig(enabled=False),
    # The document cannot say which stages there are, nor what bytes are a stage, nor what /v1/limits allows: a request
    # that fits it may name no stage (422), upload something else (415), accept nothing we have (406), or ask for a part
    # that is not there (416). So these are allowed too; `test_well_formed_requests...` below holds what that loses.
    "positive_data_acceptance": options.PositiveDataAcceptanceConfig(
        expected_statuses=["2xx", "304", "404", "406", "409", "415", "416", "422", "429"]
    ),
}
"""Every check of schemathesis is on as it comes, but for these."""
HEADERS: list[dict[str, str]] = [
    {}, {"Accept": "application/json"}, {"Prefer": "respond-async"}, {"Accept": "image/x-exr, model/*;q=0.5"},
    {"If-None-Match": "*"}, {"Accept": "text/nothing"}, {"Accept": ";;q=x,"}, {"Range": "bytes=2-9"},
    {"Range": "bytes=999999999-"}, {"Range": "lines=1-2"},
]  # fmt: skip


@dataclass
class Seen:
    """What a run of schemathesis found."""

    checks: Counter[str] = field(default_factory=Counter)
    answers: Counter[tuple[str, int]] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("schema")
    (folder / "tokens").write_text(TOKEN)
    words = ("--stage-root", str(GOOD), "--workers", "1", "--limit", "pixels=2048", "--limit", "samples=2",
             *PATIENT, "--token-file", str(folder / "tokens"))  # fmt: skip
    with running(folder / "data", *words) as server:
        yield server


@pytest.fixture(scope="module")
def jobs(server: Server) -> list[str]:
    """A finished job of each kind, for what asks for a job."""
    found = []
    with server.client(headers=AUTHORIZED) as client:
        for verb in WORK:
            settings = {**SMALL, "aovs": ["Z"]} if verb == "render" else {}
            sent = {"stage": "window.usda", **settings}
            found.append(client.post(f"/v1/{verb}", json=sent).headers["content-location"].rpartition("/")[2])
    return found


@pytest.fixture
def prepared(jobs: list[str]) -> Iterator[None]:
    """Requests that are right name a stage, or a job, that is there; headers go round, for each operation by itself."""
    dice = random.Random(1)
    rounds: defaultdict[str, Iterator[dict[str, str]]] = defaultdict(lambda: cycle(HEADERS))

    def before_call(context: Any, case: Any, kwargs: Any) -> None:
        if not case.meta or case.meta.generation.mode.value != "positive":
            return
        if any(part.mode.value != "positive" for part in case.meta.components.values()):
            return
        case.headers = {**(case.headers or {}), **next(rounds[case.operation.label])}
        of_a_job = "identifier" in case.path_parameters and not case.operation.path.startswith("/v1/live")
        if of_a_job and dice.random() < 0.75:
            case.path_parameters["identifier"] = dice.choice(jobs)
            if "name" in case.path_parameters:
                case.path_parameters["name"] = "Z"
        if isinstance(case.body, dict) and case.media_type == "multipart/form-data":
            case.body.update({name: text for name, text in (("stage", BALL), ("settings", "{}")) if name in case.body})
        elif isinstance(case.body, dict) and "stage" in case.body and dice.random() < 0.75:
            case.body["stage"] = "window.usda"
            case.body.pop("webhook", None)  # there is no key
            if case.operation.path == "/v1/render" and dice.random() < 0.5:  # what this stage has, and the limits allow
                for name in ("variants", "widths", "time_codes", "camera", "overrides", "image_height"):
                    case.body.pop(name, None)
                case.body.update(SMALL)

    schemathesis.hook(before_call)
    yield
    schemathesis.hooks.unregister(before_call)


def explored(server: Server) -> Seen:
    schema = schemathesis.openapi.from_url(f"{server.url}openapi.json", config=options.SchemathesisConfig())
    schema.config.headers = AUTHORIZED
    schema.config.generation = options.GenerationConfig(
        max_examples=EXAMPLES, deterministic=True, no_shrink=True, database="none"
    )
    schema.config.checks = options.ChecksConfig(**CHECKS)
    schema.config.continue_on_failure = True
    schema.config.request_timeout = PATIENCE
    seen = Seen()
    for event in from_schema(schema).execute():
        if isinstance(event, events.NonFatalError | events.FatalError):
            seen.failures.append(f"schemathesis itself: {getattr(event, 'info', event)}")
        if isinstance(event, events.ScenarioFinished):
            _note(event.recorder, seen)
    return seen


def _note(recorder: Any, seen: Seen) -> None:
    for identifier, interaction in recorder.interactions.items():
        label = recorder.cases[identifier].value.operation.label
        if interaction.response is not None:
            seen.answers[(label, interaction.response.status_code)] += 1
        for check in recorder.checks.get(identifier, ()):
            seen.checks[check.name] += 1
            if check.failure_info:
                request, response = interaction.request, interaction.response
                answer = f"{response.status_code} {response.content[:300]!r}" if response else "no answer"
                seen.failures.append(
                    f"{check.name}: {check.failure_info.failure.message}\n    {request.method} {request.uri} "
                    f"{(request.body or b'')[:300]!r}\n    -> {answer}"
                )


@pytest.mark.usefixtures("prepared")
def test_every_answer_is_as_the_document_says(server: Server) -> None:
    seen = explored(server)
    assert not seen.failures, "\n".join(sorted(seen.failures)[:20])
    checks = {"not_a_server_error", "status_code_conformance", "content_type_conformance", "negative_data_rejection",
              "response_schema_conformance", "unsupported_method", "allow_header_conformance",
              "positive_data_acceptance", "ensure_resource_availability", "ignored_auth",
              "response_headers_conformance"}  # fmt: skip
    assert checks <= seen.checks.keys()
    with server.client(headers=AUTHORIZED) as client:
        paths = client.get("/openapi.json").json()["paths"]
        operations = {f"{method.upper()} {path}" for path, methods in paths.items() for method in methods}
    assert operations == {label for label, _ in seen.answers}
    for verb in WORK:  # good requests were among them, and bad ones
        statuses = {status for label, status in seen.answers if label == f"POST /v1/{verb}"}
        assert {200, 202, 406, 422} <= statuses, (verb, statuses)
    results = {status for label, status in seen.answers if label.startswith("GET /v1/jobs/")}
    assert {200, 304, 404} <= results
    refused = {label for label, status in seen.answers if status == 401}
    assert refused == {label for label in operations if "/v1/" in label or "/metrics" in label}


@pytest.mark.parametrize("verb", WORK)
def test_well_formed_requests_for_a_stage_that_is_there_are_done(server: Server, verb: str) -> None:
    settings = SMALL if verb == "render" else {}
    with server.client(headers=AUTHORIZED) as client:
        assert client.post(f"/v1/{verb}", json={"stage": "marble.usda", **settings}).status_code == 200
        form = client.post(f"/v1/{verb}", files=upload(BALL), data={"settings": json.dumps(settings)})
        assert form.status_code == 200
