"""Lock this process into one folder, for good: no other files, no network, no new programs, limited means.

Linux only: Landlock (since 5.13), seccomp (x86-64 and aarch64), capabilities and rlimits. What the kernel does not
have is left out and reported by `available`. Landlock binds the calling thread and what it starts later, so the
process must have one thread when `confine` is called. Sources: landlock(7), seccomp(2), prctl(2), capabilities(7).
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Iterable
from typing import NamedTuple

_NO_NEW_PRIVS, _SECCOMP, _PDEATHSIG, _DUMPABLE = 38, 22, 1, 4
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446

_FILE_READ, _DIR_READ = 1 << 2, 1 << 3
_FILE_WRITE = (1 << 1) | (1 << 14)  # write, truncate
_DIR_WRITE = (1 << 4) | (1 << 5) | (1 << 7) | (1 << 8)  # remove and make folders and files
_RIGHTS_OF_ABI = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}

# System calls by number: what no job needs. A thread still starts by `clone` with CLONE_THREAD.
_REFUSED = {
    "x86_64": (
        41, 42, 43, 44, 46, 49, 50, 53, 288, 307,  # sockets
        57, 58, 59, 322,  # fork, vfork, execve, execveat
        101, 200, 310, 311, 424, 434, 438,  # ptrace, tkill, process_vm_*, pidfd_*
        155, 161, 165, 166, 272, 308, 428, 429, 430, 432, 442,  # pivot_root, chroot, mounts, namespaces
        246, 248, 249, 250, 298, 321, 323, 425, 175, 313,  # kexec, keys, perf, bpf, userfaultfd, io_uring, modules
    ),
    "aarch64": (
        198, 199, 200, 201, 202, 203, 206, 211, 242, 269,
        221, 281,
        117, 130, 270, 271, 424, 434, 438,
        39, 40, 41, 51, 97, 268, 428, 429, 430, 432, 442,
        104, 217, 218, 219, 241, 280, 282, 425, 105, 273,
    ),
}  # fmt: skip
_CLONE = {"x86_64": 56, "aarch64": 220}
_KILLS = {"x86_64": (62, 234), "aarch64": (129, 131)}  # kill, tgkill: only to itself
_CLONE3 = 435
_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_ALLOW, _DENY, _NOT_THERE = 0x7FFF0000, 0x00050000 | 1, 0x00050000 | 38
_LOAD, _EQUAL, _AT_LEAST, _HAS_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06


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
    return {"landlock": landlock_abi(), "seccomp": linux and platform.machine() in _REFUSED, "capabilities": linux}


def die_with_parent() -> None:
    """Be killed when the process (its thread) that started this one ends."""
    if sys.platform == "linux":
        _libc().prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def confine(readable: Iterable[str], writable: Iterable[str], means: Means) -> None:
    """Give up everything else. There is no way back.

    Args:
        readable: folders and files that may be read; what does not exist is left out.
        writable: folders where files may be made, changed and removed.

    Raises:
        OSError: something the kernel has could not be switched on.
    """
    _limit_means(means)
    if sys.platform != "linux":
        return
    libc = _libc()
    libc.prctl(_DUMPABLE, 0, 0, 0, 0)
    if libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "no_new_privs")
    if abi := landlock_abi():
        _landlock(libc, abi, readable, writable)
    _drop_capabilities(libc)
    if platform.machine() in _REFUSED:
        _filter_calls(libc, platform.machine())


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
        (resource.RLIMIT_CORE, 0, 0),
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


def _filter_calls(libc: ctypes.CDLL, machine: str) -> None:
    """Refuse system calls with EPERM, by a BPF program over struct seccomp_data (nr, arch, address, arguments)."""
    steps: list[tuple[int, int, int, int]] = [(_LOAD, 0, 0, 4), (_EQUAL, 1, 0, _AUDIT_ARCH[machine])]
    steps += [(_RETURN, 0, 0, _DENY), (_LOAD, 0, 0, 0)]
    steps += [(_AT_LEAST, 0, 1, 0x40000000), (_RETURN, 0, 0, _DENY)]  # the x32 numbers
    for number in _REFUSED[machine]:
        steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _DENY)]
    steps += [(_EQUAL, 0, 1, _CLONE3), (_RETURN, 0, 0, _NOT_THERE)]  # its flags are out of sight; glibc takes clone
    steps += [(_EQUAL, 0, 4, _CLONE[machine]), (_LOAD, 0, 0, 16)]
    steps += [(_HAS_BIT, 1, 0, 0x10000), (_RETURN, 0, 0, _DENY), (_RETURN, 0, 0, _ALLOW)]
    for number in _KILLS[machine]:
        steps += [(_EQUAL, 0, 4, number), (_LOAD, 0, 0, 16)]
        steps += [(_EQUAL, 1, 0, os.getpid()), (_RETURN, 0, 0, _DENY), (_RETURN, 0, 0, _ALLOW)]
    steps += [(_RETURN, 0, 0, _ALLOW)]
    code = b"".join(struct.pack("HBBI", *step) for step in steps)
    buffer = ctypes.create_string_buffer(code, len(code))
    program = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(buffer))
    if libc.prctl(_SECCOMP, 2, program, 0, 0):
        raise OSError(ctypes.get_errno(), "seccomp")
