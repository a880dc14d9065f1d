"""Lock this process into one folder, for good: no other files, no network, no new programs, limited means.

Linux only: Landlock (since 5.13), seccomp (x86-64 and aarch64), capabilities, rlimits, and namespaces where they may be
made. What the kernel does not have is left out and reported by `available` and `missing`. Landlock binds the calling
thread and what it starts later, so the process must have one thread when `confine` is called. Sources: landlock(7),
prctl(2), capabilities(7).
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
import sys
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from refract_core.errors import UsageError

from . import namespaces, seccomp

_NO_NEW_PRIVS, _PDEATHSIG, _DUMPABLE = 38, 1, 4
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446

_FILE_READ, _DIR_READ = 1 << 2, 1 << 3
_FILE_WRITE = (1 << 1) | (1 << 14)  # write, truncate
_DIR_WRITE = (1 << 4) | (1 << 5) | (1 << 7) | (1 << 8)  # remove and make folders and files
_RIGHTS_OF_ABI = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}


class Means(NamedTuple):
    """What a process may use from now on."""

    memory_bytes: int
    """Beyond what it has mapped already."""
    cpu_seconds: int
    """Beyond what it has used already."""
    file_bytes: int
    open_files: int


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def landlock_abi() -> int:
    """Version of Landlock in this kernel; 0 where there is none."""
    if sys.platform != "linux":
        return 0
    return max(0, int(_libc().syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), 1)))


def available() -> dict[str, int | bool]:
    """What can be enforced on this machine, besides rlimits and the check of a stage's files."""
    linux = sys.platform == "linux"
    return {"landlock": landlock_abi(), "seccomp": seccomp.works(), "capabilities": linux,
            "namespaces": namespaces.works()}  # fmt: skip


_WITHOUT = {
    "landlock": "no Landlock: a worker that is taken over may read and write what the service may",
    "seccomp": "no seccomp: a worker that is taken over may use the network and end other processes",
    "capabilities": "no capabilities: this is not Linux",
    "namespaces": "no namespaces: a worker that is taken over can tell which files there are, and their sizes",
}
NEEDED = ("landlock", "seccomp", "capabilities")
"""Without one of these, a worker that is taken over is not alone."""


def missing(found: Mapping[str, object]) -> dict[str, str]:
    """What this machine does not enforce, and what that means, by the names in `available`."""
    return {name: text for name, text in _WITHOUT.items() if not found.get(name)}


def required(found: Mapping[str, object]) -> None:
    """Raises UsageError where a worker that is taken over would not be alone on this machine."""
    lacking = [text for name, text in missing(found).items() if name in NEEDED]
    if lacking:
        raise UsageError(f"--require-confinement: this machine has {'; '.join(lacking)}")


def die_with_parent() -> None:
    """Be killed when the process (its thread) that started this one ends."""
    if sys.platform == "linux":
        _libc().prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def confine(readable: Iterable[str], writable: Iterable[str], means: Means, place: str = "") -> None:
    """Give up everything else. There is no way back.

    Args:
        readable: folders and files that may be read; what does not exist is left out.
        writable: folders where files may be made, changed and removed.
        place: an empty folder, for a root with these alone; '' does without.

    Raises:
        OSError: something the kernel has could not be switched on.
    """
    _limit_means(means)
    if sys.platform != "linux":
        return
    libc, parent = _libc(), os.getppid()
    readable, writable = list(readable), list(writable)
    if place and namespaces.works():
        namespaces.enclose(readable, writable, place)
        die_with_parent()  # a new user namespace has undone it
        if os.getppid() != parent:
            raise OSError("the parent has ended")
    abi = landlock_abi()
    # The parent may look at what is open here, which is what a quota is worth; Landlock keeps others from it.
    libc.prctl(_DUMPABLE, 1 if abi else 0, 0, 0, 0)
    if libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "no_new_privs")
    if abi:
        _landlock(libc, abi, readable, writable)
    _drop_capabilities(libc)
    if seccomp.works():
        seccomp.restrict()


def _limit_means(means: Means) -> None:
    with open("/proc/self/statm") as file:
        mapped = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu = int(used.ru_utime + used.ru_stime) + means.cpu_seconds + 1
    for what, amount, hard in (
        (resource.RLIMIT_AS, mapped + means.memory_bytes, mapped + means.memory_bytes),
        (resource.RLIMIT_CPU, cpu, cpu + 2),
        (resource.RLIMIT_FSIZE, means.file_bytes, means.file_bytes),
        (resource.RLIMIT_NOFILE, means.open_files, means.open_files),
        (resource.RLIMIT_CORE, 1, 1),  # 0 still wakes a program that gathers dumps; 1 does not (core(5))
    ):
        ceiling = resource.getrlimit(what)[1]
        top = hard if ceiling == resource.RLIM_INFINITY else min(hard, ceiling)
        resource.setrlimit(what, (min(amount, top), top))


def _landlock(libc: ctypes.CDLL, abi: int, readable: Iterable[str], writable: Iterable[str]) -> None:
    every = (1 << _RIGHTS_OF_ABI.get(abi, 16)) - 1
    attributes = struct.pack("QQQ", every, 3 if abi >= 4 else 0, 3 if abi >= 6 else 0)
    size = 8 if abi < 4 else 16 if abi < 6 else 24
    ruleset = libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(size), 0)
    if ruleset < 0:
        raise OSError(ctypes.get_errno(), "landlock_create_ruleset")
    try:
        for path in readable:
            _allow(libc, ruleset, path, (_FILE_READ | _DIR_READ) & every)
        for path in writable:
            _allow(libc, ruleset, path, (_FILE_READ | _DIR_READ | _FILE_WRITE | _DIR_WRITE) & every)
        if libc.syscall(_RESTRICT_SELF, ruleset, 0):
            raise OSError(ctypes.get_errno(), "landlock_restrict_self")
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, path: str, rights: int) -> None:
    try:
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        if not os.path.isdir(path):
            rights &= _FILE_READ | _FILE_WRITE
        if libc.syscall(_ADD_RULE, ruleset, 1, struct.pack("=Qi", rights, place), 0):
            raise OSError(ctypes.get_errno(), "landlock_add_rule")
    finally:
        os.close(place)


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Root without its powers; for anybody else nothing changes."""
    header = struct.pack("Ii", 0x20080522, 0)
    if libc.capset(header, struct.pack("6I", 0, 0, 0, 0, 0, 0)):
        raise OSError(ctypes.get_errno(), "capset")
