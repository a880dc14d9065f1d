"""A worker whose job is to get out: `service.worker` as it is, with `inspect` replaced by a list of attempts.

Started by `escape_server.py` in the place of `python -m refract_core.service.worker`. Everything before and after the
job is the real thing: the fork, the lock, the quota, the end.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import resource
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from refract_core.service import namespaces, tasks, worker  # noqa: E402

libc = ctypes.CDLL(None, use_errno=True)
X86 = platform.machine() == "x86_64"
NURSERY = os.getpid()
"""The process that forks workers; this module is loaded by it."""
SERVER = os.getppid()


def numbered(x86: int, arm: int) -> int:
    return x86 if X86 else arm


def call(number: int, *arguments: Any) -> int:
    """A system call by its number. Raises OSError."""
    result = int(libc.syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def limits_of(pid: int) -> int:
    """Set another process's limit of processor time to nothing."""
    return call(numbered(302, 261), pid, resource.RLIMIT_CPU, struct.pack("QQ", 0, 0), None)


def changed_mode(path: str) -> None:
    before = os.stat(path).st_mode
    os.chmod(path, 0o777 if before & 0o777 != 0o777 else 0o700)
    if os.stat(path).st_mode == before:
        raise PermissionError("the mode is as it was")


def changed_open_mode(path: str) -> None:
    with open(path, "rb") as file:
        before = os.fstat(file.fileno()).st_mode
        os.fchmod(file.fileno(), 0o777 if before & 0o777 != 0o777 else 0o700)
        if os.fstat(file.fileno()).st_mode == before:
            raise PermissionError("the mode is as it was")


def variables() -> None:
    """A secret of the server's environment, by all ways to one's own."""
    found = [*os.environ.values()]
    for path in ("/proc/self/environ", f"/proc/{SERVER}/environ", f"/proc/{NURSERY}/environ"):
        try:
            found.append(Path(path).read_text("utf-8", "replace"))
        except OSError:
            continue
    if not any("Xyzzy" in text for text in found):
        raise PermissionError("no secret")


def other_descriptors() -> None:
    """Anything open that is not the standard three, the socket to the server or the stage."""
    for number in range(3, 1024):
        try:
            kind = os.fstat(number).st_mode
        except OSError:
            continue
        if (kind & 0o170000) == 0o010000:  # a pipe
            return
    raise PermissionError("no pipe of others")


def sockets_open() -> None:
    """More than one socket: the nursery's own would let a worker speak for it."""
    found = 0
    for number in range(3, 1024):
        try:
            found += (os.fstat(number).st_mode & 0o170000) == 0o140000
        except OSError:
            continue
    if found <= 1:
        raise PermissionError("only the socket of the job")


def seen(path: str) -> None:
    os.stat(path)


def listed(path: str) -> None:
    os.listdir(path)


def opened(path: str, flags: int) -> None:
    os.close(os.open(path, flags))


def written(path: str) -> None:
    Path(path).write_text("x")


def ways_out(victim: str, stage: str) -> dict[str, Callable[[], Any]]:
    """Every attempt by name; each raises OSError where it fails.

    Args:
        victim: a file of the test, outside.
        stage: the stage itself, which may be read.
    """
    folder = os.path.dirname(victim)
    packed = struct.pack("QQ", 0, 0)
    return {
        # other processes
        "kill the server": lambda: os.kill(SERVER, signal.SIGTERM),
        "ask for the server": lambda: os.kill(SERVER, 0),
        "kill the nursery": lambda: os.kill(NURSERY, signal.SIGKILL),
        "kill everybody": lambda: os.kill(-1, signal.SIGKILL),
        "kill the group": lambda: os.kill(0, signal.SIGKILL),
        "tkill": lambda: call(numbered(200, 130), SERVER, 15),
        "tgkill": lambda: call(numbered(234, 131), SERVER, SERVER, 15),
        "queue a signal": lambda: call(numbered(129, 138), SERVER, 15, b"\0" * 128),
        "pidfd": lambda: os.pidfd_open(SERVER),
        "prlimit of the server": lambda: limits_of(SERVER),
        "prlimit of the nursery": lambda: limits_of(NURSERY),
        "prlimit of init": lambda: limits_of(1),
        "ptrace": lambda: call(numbered(101, 117), 16, SERVER, None, None),
        "read its memory": lambda: call(numbered(310, 270), SERVER, packed, 1, packed, 1, 0),
        "write its memory": lambda: call(numbered(311, 271), SERVER, packed, 1, packed, 1, 0),
        "its priority": lambda: os.setpriority(os.PRIO_PROCESS, SERVER, 19),
        "its cores": lambda: os.sched_setaffinity(SERVER, {0}),
        "its scheduling": lambda: os.sched_setscheduler(SERVER, os.SCHED_IDLE, os.sched_param(0)),
        "its descriptors": lambda: call(438, SERVER, 0, 0),
        "compare with it": lambda: call(numbered(312, 272), os.getpid(), SERVER, 0, 0, 0),
        "signals by a descriptor": lambda: call(numbered(72, 25), 2, 8, SERVER),
        # new processes and privileges
        "fork": lambda: os.fork() or os._exit(0),
        "vfork": lambda: call(numbered(58, 220), *(() if X86 else (0x4111, 0, 0, 0, 0))),
        "clone": lambda: call(numbered(56, 220), 17, 0, 0, 0, 0),
        "clone3": lambda: call(435, b"\0" * 64, 64),
        "execute": lambda: os.execv("/bin/true", ["true"]),
        "new namespace": lambda: call(numbered(272, 97), 0x10000000),
        "enter a namespace": lambda: call(numbered(308, 268), 0, 0),
        "mount": lambda: call(numbered(165, 40), b"tmpfs", b"/tmp", b"tmpfs", 0, None),
        "chroot": lambda: os.chroot("/"),
        "be somebody else": lambda: os.setuid(12345),
        "be root": lambda: os.setresuid(0, 0, 0),
        "new session": os.setsid,
        "keyrings": lambda: call(numbered(250, 219), 0, -3, 1),
        "bpf": lambda: call(numbered(321, 280), 0, b"\0" * 64, 64),
        "perf": lambda: call(numbered(298, 241), b"\0" * 64, 0, -1, -1, 0),
        "userfaultfd": lambda: call(numbered(323, 282), 0),
        "io_uring": lambda: call(425, 8, b"\0" * 120),
        "more memory": lambda: resource.setrlimit(resource.RLIMIT_AS, (-1, -1)),
        "another filter": lambda: call(numbered(317, 277), 1, 0, None),
        "dump its core": lambda: call(numbered(157, 167), 4, 1, 0, 0, 0),
        # what is shared
        "shared memory": lambda: call(numbered(29, 194), 0, 4096, 0o1600),
        "semaphores": lambda: call(numbered(64, 190), 0, 1, 0o1600),
        "messages": lambda: call(numbered(68, 186), 0, 0o1600),
        "posix messages": lambda: call(numbered(240, 180), b"refract", 0o102, 0o600, None),
        "posix shared memory": lambda: opened("/dev/shm/refract-escape", os.O_CREAT | os.O_RDWR),
        "memory file": lambda: os.memfd_create("x"),
        "secret memory": lambda: call(447, 0),
        "inotify": lambda: call(numbered(294, 26), 0),
        "fanotify": lambda: call(numbered(300, 262), 0, 0),
        "event": lambda: call(numbered(290, 19), 0, 0),
        "timer of the system": lambda: call(numbered(283, 85), 1, 0),
        # the network
        "socket": socket.socket,
        "unix socket": lambda: socket.socket(socket.AF_UNIX),
        "netlink": lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW),
        "packets": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
        "socket pair": socket.socketpair,
        # files
        "read a file": lambda: opened(victim, os.O_RDONLY),
        "write a file": lambda: opened(victim, os.O_WRONLY),
        "make a file beside it": lambda: opened(victim + ".new", os.O_CREAT | os.O_WRONLY),
        "path without opening": lambda: opened(victim, os.O_PATH),
        "file without a name": lambda: opened(".", os.O_TMPFILE | os.O_RDWR),
        "mode of a file": lambda: changed_mode(victim),
        "mode of the stage": lambda: changed_mode(stage),
        "mode of what is open": lambda: changed_open_mode(stage),
        "times of a file": lambda: os.utime(victim, (1, 1)),
        "times of the stage": lambda: os.utime(stage, (1, 1)),
        "owner of the stage": lambda: os.chown(stage, 1, 1),
        "attributes of the stage": lambda: os.setxattr(stage, "user.x", b"x"),
        "write the stage": lambda: opened(stage, os.O_WRONLY),
        "remove the stage": lambda: os.unlink(stage),
        "link to a file": lambda: os.link(victim, "link"),
        "symbolic link": lambda: os.symlink(victim, os.path.join(os.environ["TMPDIR"], "link")),
        "device": lambda: os.mknod(os.path.join(os.environ["TMPDIR"], "device"), 0o020600, os.makedev(1, 3)),
        "named pipe": lambda: os.mkfifo(os.path.join(os.environ["TMPDIR"], "pipe")),
        "lock a file": lambda: call(numbered(73, 32), 2, 2),
        "kernels": lambda: written(os.path.join(worker.own_files()[3], "escape")),
        "list the root of stages": lambda: listed(folder),
        "list users": lambda: listed("/home"),
        "passwords": lambda: opened("/etc/passwd", os.O_RDONLY),
        "the server's folder in proc": lambda: listed(f"/proc/{SERVER}"),
        "the server's memory": lambda: opened(f"/proc/{SERVER}/mem", os.O_RDONLY),
        "secrets in the environment": variables,
        "pipes of others": other_descriptors,
        "sockets of others": sockets_open,
        "terminal": lambda: call(numbered(16, 29), 0, 0x5412, b"x"),
        "clock": lambda: time.clock_settime(time.CLOCK_REALTIME, 0),
        "name of the machine": lambda: call(numbered(170, 161), b"x", 1),
        "restart": lambda: call(numbered(169, 142), 0, 0, 0, None),
        "swap": lambda: call(numbered(167, 224), b"/x", 0),
        "log of the kernel": lambda: call(numbered(103, 116), 3, ctypes.create_string_buffer(64), 64),
        "sync all disks": lambda: call(numbered(162, 81)),
        "a call nobody knows": lambda: call(5000),
    }  # fmt: skip


HIDDEN: dict[str, Callable[[str], None]] = {
    "whether a file is there": seen, "passwords are there": lambda _victim: seen("/etc/passwd"),
    "the server is there": lambda _victim: seen(f"/proc/{SERVER}"),
}  # fmt: skip
"""What only namespaces refuse."""


def attempt(what: Callable[[], Any]) -> str:
    try:
        what()
    except (OSError, ValueError) as error:
        return f"refused: {error}"
    return "allowed"


def try_all(stage: str, out: str, settings: Mapping[str, Any], limits: Mapping[str, int], say: Any) -> dict[str, Any]:
    """In the place of `inspect`. What to do stands in the stage, after its first line."""
    order = json.loads(Path(stage).read_text().partition("# ")[2])
    if order["do"] != "all":
        GREED[order["do"]](out)
        time.sleep(60)
        return {}
    victim = order["victim"]
    found = {name: attempt(what) for name, what in ways_out(victim, stage).items()}
    hidden = {name: attempt(partial(what, victim)) for name, what in HIDDEN.items()}
    (Path(out) / "report.json").write_text(json.dumps({"refused": found, "hidden": hidden}))
    return {}


TENS = 130
"""Files of 10 MiB: more than a job may have by default."""


def fill(out: str) -> None:
    for number in range(TENS):
        with open(os.path.join(out, f"a{number}"), "wb") as file:
            for _ in range(10):
                file.write(bytes(1 << 20))


def fill_removed(_out: str) -> None:
    held = []
    for number in range(TENS):
        name = os.path.join(os.environ["TMPDIR"], f"a{number}")
        file = open(name, "wb")  # noqa: SIM115  held open, which is the point
        held.append(file)
        os.unlink(name)
        file.write(bytes(10 << 20))
        file.flush()
    time.sleep(60)


def many_files(_out: str) -> None:
    for number in range(5000):
        os.mkdir(os.path.join(os.environ["TMPDIR"], f"a{number}"))


def deep(_out: str) -> None:
    here = os.open(os.environ["TMPDIR"], os.O_RDONLY | os.O_DIRECTORY)
    for _ in range(3000):
        os.mkdir("a" * 200, dir_fd=here)
        inner = os.open("a" * 200, os.O_RDONLY | os.O_DIRECTORY, dir_fd=here)
        os.close(here)
        here = inner


def many_threads(_out: str) -> None:
    threading.stack_size(65536)
    for _ in range(2000):
        threading.Thread(target=time.sleep, args=(60,), daemon=True).start()


GREED = {"fill": fill, "fill removed": fill_removed, "many files": many_files, "deep": deep,
         "many threads": many_threads}  # fmt: skip

if __name__ == "__main__":
    if "--without-namespaces" in sys.argv:
        namespaces.works = lambda: False
    tasks._VERBS["inspect"] = try_all
    worker.main()
