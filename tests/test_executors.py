"""Work on other machines: the same bytes as here, each once, whatever happens to a worker."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from bake_studio import STAGE as PROBES
from typer.testing import CliRunner

from refract_core.cli import app
from refract_core.errors import Cancelled, RefractError, StageError, UsageError
from refract_core.progress import Report
from refract_core.settings import Opening
from refract_core.verbs import executors
from refract_core.verbs.bake_probes import BakeOrder, bake_probes
from refract_core.verbs.executors import Bench, Crew, Sent, crew_at, patience, sent_stage, spread
from refract_core.verbs.render_files import Order, render_files

# Dask leaves sockets and loops of its own for the garbage collector.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.mark.slow
def test_what_watches_processes_is_kept_to_one_worker(request: pytest.FixtureRequest) -> None:
    """By pytest-xdist, which says nothing where it does not."""
    if not request.config.getoption("loadgroup", False):
        pytest.skip("tests are not run by --dist loadgroup")
    assert request.node.nodeid.endswith("@processes")


STAGE = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 8
    subLayers = [@light.usda@]
)
def Camera "Eye"
{
    double3 xformOp:translate = (0, 1, 6)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Cube "Floor"
{
    double3 xformOp:translate = (0, -2, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Sphere "Ball" (
    references = @missing.usda@
)
{
    double3 xformOp:translate.timeSamples = { 1: (-2, 0, 0), 8: (2, 0.5, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
LIGHT = """#usda 1.0
def DomeLight "Sky"
{
    color3f inputs:color = (0.3, 0.6, 0.9)
}
"""
SMALL = {"image_width": 32, "samples": 1, "jobs": 1}
PATIENCE = 300.0
"""[s] Longest wait for what has to happen, on a machine whose cores are busy with other things."""


@dataclass
class Heard:
    """Everything a command said."""

    done: list[str] = field(default_factory=list)
    warned: list[tuple[str, str]] = field(default_factory=list)
    fractions: list[float] = field(default_factory=list)
    on_done: Callable[[], None] = lambda: None

    def report(self) -> Report:
        def say_done(path: str, _text: str) -> None:
            self.done.append(path)
            self.on_done()

        def say(fraction: float, _text: str) -> None:
            self.fractions.append(fraction)

        return Report(say, lambda path, text: self.warned.append((path, text)), say_done, lambda _text: None)


def never() -> bool:
    return False


def nothing() -> None:
    pass


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    (tmp_path / "light.usda").write_text(LIGHT)
    (tmp_path / "stage.usda").write_text(STAGE)
    return tmp_path / "stage.usda"


def order_of(stage: Path, folder: str, **changes: Any) -> Order:
    out = stage.parent / folder
    out.mkdir(exist_ok=True)
    values: dict[str, Any] = {"frames": "1:8", "overrides": SMALL, **changes}
    return Order(stage=str(stage), out=str(out / "p.#.exr"), **values)


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- with a crew of threads


@pytest.fixture
def threads() -> Iterator[Crew]:
    with ThreadPoolExecutor(2) as pool:
        yield Crew(pool, lambda: 2, lambda data: data)


def echo(_bench: Bench, item: Any) -> Any:
    return item


def fail(_bench: Bench, item: Any) -> Any:
    raise UsageError(f"item {item}") if item == 3 else ValueError("of something else")


def test_every_item_comes_back_once(stage: Path, threads: Crew) -> None:
    sent = sent_stage(str(stage), "name")
    found = list(spread(threads, echo, range(100), sent, stop=nothing, waiting=nothing))
    assert sorted(found) == [(k, k) for k in range(100)]


def test_what_a_piece_of_work_raises_arrives(stage: Path, threads: Crew) -> None:
    sent = sent_stage(str(stage), "name")
    with pytest.raises(UsageError, match="item 3"):
        list(spread(threads, fail, [3], sent, stop=nothing, waiting=nothing))
    with pytest.raises(RefractError, match="ValueError: of something else"):
        list(spread(threads, fail, [4], sent, stop=nothing, waiting=nothing))


def test_workers_of_another_version_are_refused(stage: Path, threads: Crew) -> None:
    sent = sent_stage(str(stage), "name")._replace(version="0.0.0")
    with pytest.raises(RefractError, match=r"not 0\.0\.0; install the same"):
        list(spread(threads, echo, [1], sent, stop=nothing, waiting=nothing))


def test_a_stage_that_changes_meanwhile_is_not_mixed(stage: Path, threads: Crew) -> None:
    """Its sublayer counts too."""
    sent = sent_stage(str(stage), "name")
    (stage.parent / "light.usda").write_text(LIGHT.replace("0.9", "0.8"))
    with pytest.raises(StageError, match="was changed"):
        list(spread(threads, echo, [1], sent, stop=nothing, waiting=nothing))


def paths(bench: Bench, _item: Any) -> list[str]:
    scene = bench.read()
    return sorted([mesh.path for mesh in scene.meshes] + [ball.path for ball in scene.spheres])


def test_workers_open_a_stage_as_it_was_ordered(tmp_path: Path, threads: Crew) -> None:
    stage = tmp_path / "two.usda"
    stage.write_text('#usda 1.0\ndef Sphere "A" {\n}\ndef Sphere "B" {\n}\n')
    sent = sent_stage(str(stage), "name", Opening(mask=("/B",)))
    assert list(spread(threads, paths, [0], sent, stop=nothing, waiting=nothing)) == [(0, ["/B"])]


def test_a_session_layer_is_not_sent(stage: Path) -> None:
    with pytest.raises(UsageError, match=r"^--session-layer .*light\.usda: is not sent to a cluster"):
        sent_stage(str(stage), "name", Opening(session_layer=str(stage.parent / "light.usda")))


def test_without_workers_it_waits_and_says_so_once(stage: Path, threads: Crew) -> None:
    widths = iter([0, 0, 0])
    heard = Heard()
    crew = threads._replace(width=lambda: next(widths, 2))
    sent = sent_stage(str(stage), "name")
    assert len(list(spread(crew, echo, range(9), sent, stop=nothing, waiting=patience(heard.report())))) == 9
    assert [path for path, _ in heard.warned] == ["--executor"]


# --- addresses


@pytest.mark.parametrize("address", ["dask", "dask://", "dask://here", "dask://here:x", "dask://a:99999", "ray://a:1"])
def test_an_address_that_is_none(address: str, stage: Path) -> None:
    ended = CliRunner().invoke(app, ["render", str(stage), str(stage.parent / "a.png"), "--executor", address])
    assert (ended.exit_code, "dask://HOST:PORT" in ended.stderr) == (2, True), ended.stderr


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"usd-refract\[dask\]"), crew_at("dask://127.0.0.1:8786"):
        pass


def test_nobody_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "CONNECT_SECONDS", 0.5)
    with socket.socket() as taken:  # bound, but not listening
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(RefractError, match="no Dask scheduler answers"), crew_at(address_of(taken)):
            pass


def address_of(bound: socket.socket) -> str:
    return f"dask://127.0.0.1:{bound.getsockname()[1]}"


# --- with a cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "host": "127.0.0.1"}
    with distributed.LocalCluster(**options, dashboard_address="127.0.0.1:0", silence_logs=50) as two:
        yield two


@pytest.fixture
def crew(cluster: Any) -> Iterator[Crew]:
    with crew_at(cluster.scheduler_address.replace("tcp://", "dask://")) as found:
        assert found is not None
        yield found


@pytest.fixture
def client(cluster: Any) -> Iterator[Any]:
    """To look at the cluster from outside."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(cluster, set_as_default=False) as found:
        found.wait_for_workers(2, timeout=PATIENCE)
        yield found


class Doomed:
    """A worker that takes work and does not do it: it stands still from now on, and dies when it is told to."""

    def __init__(self, client: Any) -> None:
        self.client, self.killed_with = client, 0
        self.worker, self.pid = sorted(client.run(os.getpid).items())[0]
        os.kill(self.pid, signal.SIGSTOP)

    def die(self) -> None:
        """Once. Notes with how many pieces of work."""
        if not self.killed_with:
            self.killed_with = len(self.client.processing()[self.worker])
            os.kill(self.pid, signal.SIGKILL)


@pytest.mark.slow
def test_frames_are_those_rendered_here_though_a_worker_dies(stage: Path, crew: Crew, client: Any) -> None:
    here, there = Heard(), Heard()
    render_files(order_of(stage, "here"), here.report(), never)
    doomed = Doomed(client)
    there.on_done = doomed.die
    render_files(order_of(stage, "there"), there.report(), never, crew)
    assert doomed.killed_with > 0
    assert sorted(there.done) == [str(stage.parent / "there" / f"p.{k}.exr") for k in range(1, 9)]
    expected = files_in(stage.parent / "here")
    assert len(set(expected.values())) == 8, "the frames must differ, or mixing them up would not be seen"
    assert files_in(stage.parent / "there") == expected
    assert here.warned  # of the missing reference
    assert there.warned == here.warned
    assert (there.fractions[-1], there.fractions) == (1.0, sorted(there.fractions))


def hide(hidden: bool, dask_worker: Any) -> int:
    """Makes a worker find the stage's files, or not. Returns how many stages it was sent."""
    real = executors.__dict__.setdefault("_really_is_here", executors._is_here)
    executors.__dict__["_is_here"] = (lambda _sent: False) if hidden else real
    return len(list(Path(dask_worker.local_directory).glob("refract-stage-*")))


@pytest.mark.slow
def test_a_stage_that_workers_cannot_see_goes_there_once(stage: Path, crew: Crew, client: Any) -> None:
    here, there = Heard(), Heard()
    render_files(order_of(stage, "here", frames="1:6"), here.report(), never)
    client.run(hide, True)
    try:
        render_files(order_of(stage, "there", frames="1:6"), there.report(), never, crew)
    finally:
        counts = client.run(hide, False)
    assert max(counts.values()) == 1  # one of them may have had no frame to draw
    assert files_in(stage.parent / "there") == files_in(stage.parent / "here")
    assert sorted(there.done) == sorted(path.replace("here", "there") for path in here.done)


@pytest.mark.slow
def test_errors_of_a_frame_are_those_it_has_here(stage: Path, crew: Crew) -> None:
    texts = []
    for place in (None, crew):
        with pytest.raises(RefractError) as caught:
            render_files(order_of(stage, "x", overrides={"camera": "/Nobody"}), Heard().report(), never, place)
        texts.append((type(caught.value), str(caught.value)))
    assert texts[0] == texts[1]
    assert files_in(stage.parent / "x") == {}


@pytest.mark.slow
def test_cancel_keeps_what_is_done_and_nothing_follows(stage: Path, crew: Crew) -> None:
    heard = Heard()
    with pytest.raises(Cancelled):
        render_files(order_of(stage, "x"), heard.report(), lambda: bool(heard.done), crew)
    assert sorted(path.name for path in map(Path, heard.done)) == sorted(files_in(stage.parent / "x"))
    assert 1 <= len(heard.done) < 8


def until_cancelled(bench: Bench, folder: str) -> None:
    Path(folder, "started").touch()
    while not bench.cancel():
        time.sleep(0.02)
    Path(folder, "stopped").touch()


def appears(path: Path) -> bool:
    end = time.monotonic() + PATIENCE
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.02)
    return path.exists()


@pytest.mark.slow
def test_cancel_reaches_work_that_runs(stage: Path, crew: Crew) -> None:
    def stop() -> None:
        if (stage.parent / "started").exists():
            raise Cancelled("enough")

    sent = sent_stage(str(stage), "name")
    with pytest.raises(Cancelled, match="enough"):
        list(spread(crew, until_cancelled, [str(stage.parent)], sent, stop=stop, waiting=nothing))
    assert appears(stage.parent / "stopped")


def bake(stage: Path, folder: str, crew: Crew | None) -> tuple[dict[str, bytes], Sequence[str]]:
    (stage.parent / folder).mkdir(exist_ok=True)
    heard = Heard()
    out = stage.parent / folder / "out.usda"
    bake_probes(BakeOrder(stage=str(stage), out=str(out), resolution=8, samples=2, jobs=1), heard.report(), never,
                crew=crew)  # fmt: skip
    return {"out": out.read_bytes(), **files_in(out.with_suffix(".probes"))}, heard.done


@pytest.mark.slow
def test_probes_are_those_baked_here(tmp_path: Path, crew: Crew) -> None:
    probes = tmp_path / "probes.usda"
    probes.write_text(
        PROBES.replace('def RefractProbe "Left"', 'def RefractProbe "Third" {}\n    def RefractProbe "Left"')
    )
    here, said_here = bake(probes, "here", None)
    there, said_there = bake(probes, "there", crew)
    assert there == here
    assert len(there) == 4
    assert len(set(said_there)) == len(said_there) == len(said_here)
    again, _ = bake(probes, "there", crew)
    assert again == here


@pytest.mark.slow
def test_the_commands_take_the_address(stage: Path, cluster: Any) -> None:
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    flags = ["--image-width", "32", "--samples", "1", "--executor", address]
    ended = CliRunner().invoke(app, ["render", str(stage), str(stage.parent / "p.#.png"), "--frames", "1:2", *flags])
    assert ended.exit_code == 0, ended.output
    assert (stage.parent / "p.2.png").exists()
    ended = CliRunner().invoke(app, ["bake", "probes", str(stage), str(stage.parent / "o.usda"), "--executor", address])
    assert ended.exit_code == 0, ended.output
    assert (stage.parent / "o.usda").exists()


def test_orders_are_told_apart(stage: Path) -> None:
    """What a worker keeps open belongs to one command, so the next one sees files as they are then."""
    orders: set[Sent] = {sent_stage(str(stage), "name") for _ in range(2)}
    assert len({sent.order for sent in orders}) == 2
    assert {path for path, _ in orders.pop().files} == {str(stage), str(stage.parent / "light.usda")}
