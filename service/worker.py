"""The process that is never given a stage, and its children, which are given one each.

`python -m refract_core.service.worker FD` loads everything once (imports, compiled kernels), with a single thread, and
then forks at the server's word: a fork of it is warm at once. A child waits on its own socket for one job, locks itself
into the job's folder, and only then opens the stage. Nothing a child does comes back to its parent but its exit code.

Messages are JSON. Server to this process: {"fork": id} with a socket, {"kill": id}; back: {"ready": ...},
{"ended": id, "code": n}. Server to a child: one line, the job; back: `began`, lines of progress and warnings, and one
of `done` or `problem`.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import sys
import tempfile
import traceback
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

from . import confine
from .quota import OFTEN, WORDS, Quota
from .uploads import ARCHIVE

_QUIET = {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENIMAGEIO_THREADS": "1",
          "PXR_AR_DISABLE_PLUGIN_RESOLVER": "1", "PXR_AR_DISABLE_PLUGIN_URI_RESOLVERS": "1",
          "TF_ENV_SETTING_ALERTS_ENABLED": "0"}  # fmt: skip
_HURRY = 0.01  # [s] a job that waited in the queue comes at once
_NAMED = ("PATH", "HOME", "TMPDIR", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "LD_LIBRARY_PATH", "PYTHONHOME", "PYTHONPATH",
          "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "XDG_CACHE_HOME", "REFRACT_CACHE_DIR", "REFRACT_KERNELS")
"""What a worker gets of the server's environment: where programs and kernels are, and nothing that may be a secret."""


def environment() -> dict[str, str]:
    """Variables of the worker: libraries without threads of their own, no plug-ins, no secrets of the server."""
    return {**{name: os.environ[name] for name in _NAMED if name in os.environ}, **_QUIET}


def main() -> None:
    confine.die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's to handle
    given = int(sys.argv[1])
    control = socket.socket(fileno=os.dup(given))  # a low number: the server may have a thousand others open
    os.close(given)
    os.dup2(2, 1)  # libraries print
    threads = _warm()
    found = confine.available()
    _send(control, {"ready": {**found, "missing": list(confine.missing(found)), "threads": threads}})
    children: dict[int, _Given] = {}
    wake, waker = os.pipe()
    ears: list[Any] = [control, wake]
    os.set_blocking(waker, False)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    signal.set_wakeup_fd(waker)
    while True:
        readable, _, _ = select.select([*ears, *_doors(children)], [], [], _patience(children))
        _watch(children)
        if wake in readable:
            os.read(wake, 4096)
            _reap(control, children)
        if control in readable and not _obey(control, children):
            for pid in children:
                os.kill(pid, signal.SIGKILL)
            return


class _Given:
    """A child, as the process that forked it knows it."""

    def __init__(self, identifier: str, door: int) -> None:
        self.identifier, self.door = identifier, door
        self.quota: Quota | None = None
        """What its job may take, once it has one."""

    def open(self) -> None:
        """Hear which folder the child was given: it tells before it reads the stage, and once."""
        data = os.read(self.door, 65536)
        self.close()
        if data:
            folder, most_bytes, most_files = json.loads(data)
            self.quota = Quota(str(folder), int(most_bytes), int(most_files))

    def close(self) -> None:
        if self.door >= 0:
            os.close(self.door)
            self.door = -1


def _doors(children: dict[int, _Given]) -> list[int]:
    return [child.door for child in children.values() if child.door >= 0]


def _patience(children: dict[int, _Given]) -> float | None:
    """[s] until the next look at what children take; None where none of them is at work."""
    return OFTEN if any(child.quota for child in children.values()) else None


def _watch(children: dict[int, _Given]) -> None:
    """End those that take too much, with a word of it in their log."""
    for pid, child in children.items():
        if child.door >= 0 and select.select([child.door], [], [], 0)[0]:
            child.open()
        if child.quota and (text := child.quota.excess(pid)):
            os.kill(pid, signal.SIGKILL)
            with suppress(OSError):
                log = os.path.join(child.quota.folder, "worker.log")
                descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC)
                with open(descriptor, "a") as file:
                    file.write(f"\n{WORDS}: {text}\n")
            child.quota = None


def _warm() -> int:
    """Load everything. Returns the number of threads there are then; above 1, a fork would not be safe."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})  # Embree starts a thread for every further core it sees
    import refract_core.usd.rules.overview
    import refract_core.usd.rules.stage
    import refract_core.usd.stage
    import refract_core.verbs.convert
    import refract_core.verbs.inspect  # noqa: F401
    from refract_core.usd.layers import mtlx

    from . import live_worker, precheck, tasks, warm  # noqa: F401  the first is needed once USD is open

    mtlx.make_ready()
    warm.draw()
    os.sched_setaffinity(0, cores)
    return len(os.listdir("/proc/self/task"))


def _send(control: socket.socket, message: dict[str, Any]) -> None:
    with suppress(OSError):
        control.send(json.dumps(message).encode())


def _reap(control: socket.socket, children: dict[int, _Given]) -> None:
    while children:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if not pid:
            return
        child = children.pop(pid)
        child.close()
        _send(control, {"ended": child.identifier, "code": os.waitstatus_to_exitcode(status)})


def _obey(control: socket.socket, children: dict[int, _Given]) -> bool:
    data, descriptors, _, _ = socket.recv_fds(control, 65536, 1)
    if not data:
        return False
    message = json.loads(data)
    if "kill" in message:
        for pid, child in children.items():
            if child.identifier == message["kill"]:
                os.kill(pid, signal.SIGKILL)
        return True
    parent = os.getpid()
    try:
        place, (door, knocker) = descriptors[0], os.pipe()
        try:
            pid = os.fork()
        except OSError:
            os.close(door)
            os.close(knocker)
            raise
    except (IndexError, OSError):  # no descriptor or no process is left; the server asks again
        for descriptor in descriptors:
            os.close(descriptor)
        _send(control, {"ended": message["fork"], "code": -9})
        return True
    if pid == 0:
        signal.set_wakeup_fd(-1)
        _child(place, knocker, parent)
    os.close(place)
    os.close(knocker)
    children[pid] = _Given(message["fork"], door)
    return True


def _child(descriptor: int, knocker: int, parent: int) -> None:
    """One job, then the end.

    Args:
        descriptor: socket to the server.
        knocker: pipe to the parent, which hears by it what the job may take.
    """
    code = 1
    try:
        confine.die_with_parent()
        if os.getppid() == parent:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            _keep_open(descriptor, knocker)
            code = _serve(descriptor, knocker)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _keep_open(*wanted: int) -> None:
    """Close what the parent had open: its socket to the server, its pipes, those of other workers."""
    edges = [2, *sorted(wanted), os.sysconf("SC_OPEN_MAX")]
    for below, above in pairwise(edges):
        os.closerange(below + 1, above)


def _serve(descriptor: int, knocker: int) -> int:
    if not select.select([descriptor], [], [], _HURRY)[0]:  # nobody waits for this worker yet
        from . import warm

        warm.draw(("traced",))
    orders = os.fdopen(descriptor, "rb", closefd=False)
    line = orders.readline()
    if not line:
        return 0
    job = json.loads(line)
    _knock(knocker, job)
    os.write(descriptor, b'{"began": true}\n')

    def say(**message: Any) -> None:
        data = json.dumps(message, allow_nan=False).encode() + b"\n"
        while data:
            data = data[os.write(descriptor, data) :]

    from .problems import Problem
    from .shortage import problem_of_job

    try:
        say(done=_perform(job, say, orders))
    except Problem as told:
        problem = problem_of_job(told) or told  # a full disk is no fault of the stage
        say(problem={"slug": problem.slug, "detail": problem.detail, "errors": problem.errors, "prim": problem.prim})
    except UnicodeDecodeError:  # what USD says of a damaged file may hold pieces of it
        say(problem={"slug": "stage-invalid", "detail": "the stage cannot be read as USD", "errors": [], "prim": ""})
    except MemoryError:
        say(problem={"slug": "memory-limit", "detail": "the job ran out of memory", "errors": [], "prim": ""})
    except Exception as error:
        traceback.print_exc()  # to the job's own log
        problem = problem_of_job(error) or Problem("worker-fault", "the program failed on this stage")
        say(problem={"slug": problem.slug, "detail": problem.detail, "errors": [], "prim": ""})
    return 0


def _knock(knocker: int, job: dict[str, Any]) -> None:
    """Tell the parent which folder to watch."""
    limits = job["limits"]
    most_bytes, most_files = limits["folder_bytes"], limits["folder_files"]
    if job["stage"].endswith(ARCHIVE):  # laid out beside what the job itself writes
        most_bytes, most_files = most_bytes + limits["stage_bytes"], most_files + 2 * limits["upload_files"]
    quota = [os.path.realpath(job["folder"]), most_bytes, most_files]
    os.write(knocker, json.dumps(quota).encode())
    os.close(knocker)


def _perform(job: dict[str, Any], say: Any, orders: BinaryIO) -> Any:
    """Lock this process in, check what the stage names, do the job.

    Args:
        orders: what a live worker is asked for, after its job.
    """
    from . import live_worker, precheck, reading, tasks
    from .problems import Problem

    limits, root, folder = job["limits"], os.path.realpath(job["root"]), os.path.realpath(job["folder"])
    out, scratch = os.path.join(folder, "out"), os.path.join(folder, "tmp")
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    os.chdir(root)
    sys.path[:] = [place for place in sys.path if place]
    _say_to(os.path.join(folder, "worker.log"))
    _no_new_kernels()
    means = confine.Means(
        limits["memory_bytes"], limits["cpu_seconds"], limits["result_bytes"], limits["open_files"]
    )
    place = os.path.join(folder, "root")
    os.mkdir(place, 0o700)
    confine.confine([*own_files(), root], [out, scratch], means, place)
    if job.get("forbidden"):  # for tests: prove that the lock holds
        return _try_to_escape(job["forbidden"])
    reading.begins(limits["stage_seconds"])
    stage, root = tasks.laid_out(job["stage"], root, job["settings"], limits)
    try:
        held = precheck.check_stage(stage, root, layers=limits["layers"], unpacked_bytes=limits["stage_bytes"])
        precheck.check_size(stage, limits["prims"])
    except precheck.TooMany as error:
        raise Problem("limit-exceeded", str(error)) from None
    except precheck.Refused as error:
        raise Problem("stage-refused", str(error)) from None
    verb = live_worker.verb(orders) if job["kind"] == "live" else None
    done = tasks.perform(job["kind"], stage, out, job["settings"], limits, say, verb)
    del held  # until here, for USD to find its layers read
    return done


def own_files() -> list[str]:
    """What the program itself is made of, and nothing else of the machine."""
    import refract_core
    from refract_core.images import denoise
    from refract_core.kernels.compile import cache_root
    from refract_core.usd.registering import FOLDER

    own = [str(Path(refract_core.__file__).parent), str(FOLDER), str(Path(__file__).parent)]
    system = ["/usr/lib", "/lib", "/lib64", "/etc/ld.so.cache", "/dev/null", "/dev/urandom", "/proc/cpuinfo",
              "/proc/meminfo", "/sys/devices/system/cpu"]  # fmt: skip
    if folder := denoise.folder():
        own.append(folder)  # it loads what it is made of when it is first needed
    return [*own, str(cache_root()), *{sys.prefix, sys.base_prefix}, *system]


def _say_to(path: str) -> None:
    """What libraries print belongs to the job, not to the server's log."""
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)


def _no_new_kernels() -> None:
    """A kernel compiled here is not kept: the cache is code, and this process must not be able to write it."""
    from refract_core.kernels.compile import keep_nothing

    keep_nothing()


def _try_to_escape(path: str) -> dict[str, str]:
    tried: dict[str, Any] = {
        "read": lambda: open(path).close(),
        "write": lambda: open(path + ".new", "w").close(),
        "socket": lambda: socket.socket().close(),
        "execute": lambda: os.execv("/bin/true", ["true"]),
        "fork": os.fork,
        "signal": lambda: os.kill(os.getppid(), 0),
    }
    found = {}
    for name, attempt in tried.items():
        try:
            if attempt() == 0 and name == "fork":
                os._exit(0)
            found[name] = "allowed"
        except OSError as error:
            found[name] = str(error.strerror)
    return found


if __name__ == "__main__":
    main()
