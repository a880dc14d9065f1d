"""The system calls a worker may make. All others are refused, also those that kernels to come will have.

A list of what is allowed ages well: what it forgets shows in the tests of honest work, what a list of dangers forgets
shows in an attack. Paths cannot be looked at here, so reading and writing is Landlock's, and who may see a name the
mount namespace's. Made by hand as a BPF program over `struct seccomp_data` (number, architecture, instruction pointer,
six arguments). Sources: seccomp(2), syscalls(2), Linux `unistd_64.h` and `asm-generic/unistd.h`, BPF in `filter.txt`.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys

# Numbers for x86-64 and aarch64; -1 where an architecture has no such call.
_ALLOWED = {
    # what is open
    "read": (0, 63), "write": (1, 64), "readv": (19, 65), "writev": (20, 66), "pread64": (17, 67), "pwrite64": (18, 68),
    "close": (3, 57), "close_range": (436, 436), "fstat": (5, 80), "lseek": (8, 62), "ftruncate": (77, 46),
    "fallocate": (285, 47), "fsync": (74, 82), "fdatasync": (75, 83), "dup": (32, 23), "dup2": (33, -1),
    "dup3": (292, 24), "poll": (7, -1), "ppoll": (271, 73), "sendfile": (40, 71), "copy_file_range": (326, 285),
    # names, which Landlock and the namespace narrow down
    "stat": (4, -1), "lstat": (6, -1), "newfstatat": (262, 79), "statx": (332, 291), "access": (21, -1),
    "faccessat": (269, 48), "faccessat2": (439, 439), "readlink": (89, -1), "readlinkat": (267, 78), "getcwd": (79, 17),
    "chdir": (80, 49), "getdents64": (217, 61), "mkdir": (83, -1), "mkdirat": (258, 34), "rmdir": (84, -1),
    "unlink": (87, -1),
    "unlinkat": (263, 35), "rename": (82, -1), "renameat": (264, 38), "renameat2": (316, 276),
    # memory
    "mmap": (9, 222), "munmap": (11, 215), "mremap": (25, 216), "mprotect": (10, 226), "madvise": (28, 233),
    "brk": (12, 214), "msync": (26, 227),
    # threads of its own
    "futex": (202, 98), "set_robust_list": (273, 99), "rseq": (334, 293), "set_tid_address": (218, 96),
    "membarrier": (324, 283), "sched_yield": (24, 124), "getcpu": (309, 168), "sched_getaffinity": (204, 123),
    "rt_sigaction": (13, 134), "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139), "sigaltstack": (131, 132),
    "restart_syscall": (219, 128), "exit": (60, 93), "exit_group": (231, 94),
    # itself
    "getpid": (39, 172), "gettid": (186, 178), "getppid": (110, 173), "getuid": (102, 174), "geteuid": (107, 175),
    "getgid": (104, 176), "getegid": (108, 177), "getrusage": (98, 165), "times": (100, 153), "getrlimit": (97, 163),
    "setrlimit": (160, 164), "setitimer": (38, 103), "getitimer": (36, 102), "umask": (95, 166),
    # the machine
    "uname": (63, 160), "sysinfo": (99, 179), "getrandom": (318, 278), "time": (201, -1), "gettimeofday": (96, 169),
    "clock_gettime": (228, 113), "clock_getres": (229, 114), "clock_nanosleep": (230, 115), "nanosleep": (35, 101),
}  # fmt: skip
_SELF = -1
"""Stands for the number of the process itself."""
# Allowed where an argument has one of these values: call -> numbers, argument, values.
_ONLY = {
    # Copies, flags; not owners, signals, leases, seals, nor locks on files that others use.
    "fcntl": ((72, 25), 1, (0, 1, 2, 3, 4, 1030)),
    # Whether it is a terminal; close on exec; how much is there.
    "ioctl": ((16, 29), 1, (0x5401, 0x5450, 0x5451, 0x541B)),
    "prctl": ((157, 167), 0, (15, 16, 0x53564D41)),  # names of threads and of memory
    "kill": ((62, 129), 0, (_SELF,)),
    "tgkill": ((234, 131), 0, (_SELF,)),
    "prlimit64": ((302, 261), 0, (0, _SELF)),
    "sched_setaffinity": ((203, 122), 0, (0, _SELF)),
}
# Allowed without these bits: O_PATH, which Landlock does not ask about, and O_TMPFILE, which nobody can count.
_WITHOUT = {"open": ((2, -1), 1, 0x600000), "openat": ((257, 56), 2, 0x600000)}
# Allowed with this bit: a new thread, not a new process.
_WITH = {"clone": ((56, 220), 0, 0x10000)}
_PRETENDED = {"chmod": (90, -1), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452)}
"""Answered as done, and not done: USD takes a file it wrote for lost if its mode cannot be set."""
_NOT_THERE = {"clone3": (435, 435), "openat2": (437, 437)}
"""Their flags are behind a pointer; the C library takes the older call when told that there is no such call."""
_LAST = 462
"""The newest call looked at for this list. What is newer is said not to be there, for the same reason."""

_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
_KILL, _ALLOW, _DENY, _NO_CALL, _DONE = 0x80000000, 0x7FFF0000, 0x00050000 | 1, 0x00050000 | 38, 0x00050000
_LOAD, _EQUAL, _ABOVE, _HAS_BIT, _RETURN = 0x20, 0x15, 0x25, 0x45, 0x06
_SECCOMP = 22
_Step = tuple[int, int, int, int]


def works() -> bool:
    """This kernel filters calls, and we know the numbers of this machine's."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    number = 317 if platform.machine() == "x86_64" else 277  # seccomp(SECCOMP_GET_ACTION_AVAIL)
    action = struct.pack("I", 0x00050000)
    return int(ctypes.CDLL(None, use_errno=True).syscall(number, 2, 0, action)) == 0


def restrict() -> None:
    """From now on, for good, in this thread and those it starts. Needs no_new_privs.

    Raises:
        OSError: the kernel refuses.
    """
    steps = program(platform.machine(), os.getpid())
    code = b"".join(struct.pack("HBBI", *step) for step in steps)
    buffer = ctypes.create_string_buffer(code, len(code))
    filled = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(buffer))
    if ctypes.CDLL(None, use_errno=True).prctl(_SECCOMP, 2, filled, 0, 0):
        raise OSError(ctypes.get_errno(), "seccomp")


def program(machine: str, pid: int) -> list[_Step]:
    """Instructions: code, jump where true, jump where false, operand."""
    column, architecture = _MACHINES[machine]
    steps: list[_Step] = [(_LOAD, 0, 0, 4), (_EQUAL, 1, 0, architecture), (_RETURN, 0, 0, _KILL), (_LOAD, 0, 0, 0)]
    steps += [(_ABOVE, 0, 1, _LAST), (_RETURN, 0, 0, _NO_CALL)]  # with the numbers of x32
    for action, calls in ((_ALLOW, _ALLOWED), (_DONE, _PRETENDED), (_NO_CALL, _NOT_THERE)):
        for numbers in calls.values():
            if numbers[column] >= 0:
                steps += [(_EQUAL, 0, 1, numbers[column]), (_RETURN, 0, 0, action)]
    for numbers, argument, values in _ONLY.values():
        known = [pid if value == _SELF else value for value in values]
        found = [(_EQUAL, len(known) - place, 0, value) for place, value in enumerate(known)]
        steps += _asked(numbers[column], argument, [*found, (_RETURN, 0, 0, _DENY), (_RETURN, 0, 0, _ALLOW)])
    for numbers, argument, bits in _WITHOUT.values():
        steps += _asked(numbers[column], argument, [
            (_HAS_BIT, 0, 1, bits), (_RETURN, 0, 0, _DENY), (_RETURN, 0, 0, _ALLOW)
        ])  # fmt: skip
    for numbers, argument, bits in _WITH.values():
        steps += _asked(numbers[column], argument, [
            (_HAS_BIT, 1, 0, bits), (_RETURN, 0, 0, _DENY), (_RETURN, 0, 0, _ALLOW)
        ])  # fmt: skip
    return [*steps, (_RETURN, 0, 0, _DENY)]


def _asked(number: int, argument: int, then: list[_Step]) -> list[_Step]:
    """For one call, look at the lower half of an argument: each is an `int` to the kernel, or has its bits there."""
    if number < 0:
        return []
    return [(_EQUAL, 0, len(then) + 1, number), (_LOAD, 0, 0, 16 + 8 * argument), *then]
