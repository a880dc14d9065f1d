"""A view of the files of this machine that holds nothing but what a job needs, where the kernel lets us make one.

Landlock refuses to open what it does not know, but not to tell whether it exists, how large it is and when it was
changed (stat). In a mount namespace of its own a process has a root with only some folders in it, so there is nothing
to tell; with it come no shared memory of others (IPC), and a host name of its own. A network of nothing would cost 5 ms
more, and the filter knows no sockets. Whoever may mount may make them, others inside of a user namespace; containers
often forbid both. Sources: mount_namespaces(7), user_namespaces(7), pivot_root(2).
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Iterable
from functools import cache

_NEW_MOUNTS, _NEW_IPC, _NEW_NAMES, _NEW_USER = 0x20000, 0x08000000, 0x04000000, 0x10000000
_READ_ONLY, _NO_SUID, _NO_DEVICES, _REMOUNT, _BIND, _ALL_BELOW, _PRIVATE = 1, 2, 4, 32, 4096, 16384, 1 << 18
_KEPT = {1: 1, 2: 2, 4: 4, 8: 8, 1024: 1024, 2048: 2048, 4096: 1 << 21}
"""Flags of statvfs -> flags of mount: a user namespace may not take them away."""
_PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}
_DETACH, _DUMPABLE = 2, 4


@cache
def works() -> bool:
    """Whether a process of ours can be enclosed here; one of them is, to find out."""
    if sys.platform != "linux" or os.uname().machine not in _PIVOT_ROOT:
        return False
    with tempfile.TemporaryDirectory() as place:
        os.mkdir(os.path.join(place, "seen"))
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                enclose([os.path.join(place, "seen")], [], place)
                code = os.path.exists("/proc") or not os.path.isdir(os.path.join(place, "seen"))
            except OSError:
                pass
            finally:
                os._exit(code)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def enclose(readable: Iterable[str], writable: Iterable[str], place: str) -> None:
    """Leave nothing of this machine's files but these, at their own paths. The process must have one thread.

    Args:
        place: a folder that a root may be laid over; nothing is written into it.

    Raises:
        OSError: the kernel does not allow it; the process is of no use then.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    here, (user, group) = os.getcwd(), (os.geteuid(), os.getegid())
    others = _NEW_MOUNTS | _NEW_IPC | _NEW_NAMES
    if libc.unshare(others):  # not root
        _done(libc.unshare(_NEW_USER | others), "unshare")
        _done(libc.prctl(_DUMPABLE, 1, 0, 0, 0), "dumpable")  # else its own folder in /proc is not its own
        _write("/proc/self/setgroups", "deny")
        _write("/proc/self/uid_map", f"{user} {user} 1")
        _write("/proc/self/gid_map", f"{group} {group} 1")
    _mount(libc, None, "/", None, _ALL_BELOW | _PRIVATE)
    readable, writable = list(readable), list(writable)
    sources = {path: os.open(path, os.O_PATH | os.O_CLOEXEC) for path in _roots(readable) + _roots(writable)}
    links = {path: os.readlink(path) for path in readable if os.path.islink(path)}
    _mount(libc, "tmpfs", place, "tmpfs", _NO_SUID | _NO_DEVICES, "size=1m,nr_inodes=4096,mode=755")
    for path, source in sources.items():
        _show(libc, source, place + path, path, fixed=path not in writable)
        os.close(source)
    for path, target in links.items():
        if not os.path.lexists(place + path):
            os.makedirs(os.path.dirname(place + path), exist_ok=True)
            os.symlink(target, place + path)
    os.chdir(place)
    _done(libc.syscall(_PIVOT_ROOT[os.uname().machine], b".", b"."), "pivot_root")
    _done(libc.umount2(b".", _DETACH), "umount")
    _mount(libc, None, "/", None, _REMOUNT | _BIND | _READ_ONLY | _NO_SUID | _NO_DEVICES)
    os.chdir(here if os.path.isdir(here) else "/")


def _roots(paths: list[str]) -> list[str]:
    """Where they really are, without those that lie in others, and without what is not there."""
    real = sorted({os.path.realpath(path) for path in paths if os.path.exists(path)})
    return [path for path in real if not any(path.startswith(other.rstrip("/") + "/") for other in real)]


def _show(libc: ctypes.CDLL, source: int, target: str, path: str, *, fixed: bool) -> None:
    """Make a file or folder visible at `target`; by its descriptor, for the root may lie over its name by now."""
    name = f"/proc/self/fd/{source}"
    if not os.path.exists(target):
        os.makedirs(target if os.path.isdir(name) else os.path.dirname(target), exist_ok=True)
        if not os.path.isdir(name):
            os.close(os.open(target, os.O_CREAT | os.O_WRONLY, 0o600))
    _mount(libc, name, target, None, _BIND | _ALL_BELOW)
    there = os.statvfs(target).f_flag
    flags = sum(value for bit, value in _KEPT.items() if there & bit) | _NO_SUID
    flags |= 0 if path.startswith("/dev/") else _NO_DEVICES
    _mount(libc, None, target, None, _REMOUNT | _BIND | flags | (_READ_ONLY if fixed else 0))


def _mount(
    libc: ctypes.CDLL, source: str | None, target: str, kind: str | None, flags: int, options: str | None = None
) -> None:
    words = [None if word is None else word.encode() for word in (source, target, kind, options)]
    _done(libc.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3]), f"mount {target}")


def _done(code: int, what: str) -> None:
    if code:
        raise OSError(ctypes.get_errno(), what)


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)
