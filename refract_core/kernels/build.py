"""Compiles all kernels of the package ahead of time, into a shared object that runs without numba.

    python -m refract_core.kernels.build [FOLDER]

It needs numba and a C compiler, takes a minute or two, and knows Linux on x86-64. The code is for processors from
2013 on (AVX2 and FMA, "x86-64-v3"), and gives the same pictures as what numba compiles for the machine itself. Without
FOLDER the result goes beside this file, where `ahead` looks: in a checkout, until a source is edited.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from .ahead import ENGINE, FOLDER, MANIFEST, OBJECT, digest_of, to_json
from .compile import Kernel
from .declared import Signature, signature_of

PROCESSOR = "x86-64-v3"
_ENVIRONMENT = {"NUMBA_CPU_NAME": PROCESSOR, "NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_INTEL_SVML": "1"}
"""What numba reads when it is loaded."""
_EXTERNALS = ("rtcIntersect8", "rtcOccluded8")

_SOURCE = """
const char refract_key[] = "@KEY@";
int refract_runs_here(void) {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi")
        && __builtin_cpu_supports("bmi2");
}
"""
_CALL = """
void (*refract_to_@NAME@)(long, long, long, long);
__attribute__((visibility("hidden"))) void @NAME@(long a, long b, long c, long d) { refract_to_@NAME@(a, b, c, d); }
"""


CANNOT = 3
"""Exit code where this machine has not got what it takes."""


class CannotBuild(Exception):
    """This machine cannot compile kernels ahead of time; the message says why."""


def compiler() -> str:
    """The C compiler's command. Raises CannotBuild where there is none, or on another platform."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise CannotBuild(f"it knows Linux on x86-64 only, and this is {sys.platform} on {platform.machine()}")
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and (found := shutil.which(name)):
            return found
    raise CannotBuild("there is no C compiler (cc, gcc or clang)")


def kernels() -> dict[str, Kernel]:
    """Every kernel of the package by its full name. Imports the rooms that have some, and nothing else."""
    found: dict[str, Kernel] = {}
    for file in sorted(ENGINE.rglob("*.py")):
        if not re.search(r"^@kernel$", file.read_text("utf-8"), re.MULTILINE):
            continue
        name = ".".join([ENGINE.name, *file.relative_to(ENGINE).with_suffix("").parts])
        for value in vars(importlib.import_module(name)).values():
            if isinstance(value, Kernel) and value.py_func.__module__ == name:
                found[f"{name}.{value.py_func.__qualname__}"] = value
    return found


def sources() -> dict[str, str]:
    """Digest of every file that was imported to get at the kernels: what they call and use is in there."""
    files = {Path(str(module.__file__)) for name, module in sys.modules.items() if name.startswith(ENGINE.name)}
    return {str(f.relative_to(ENGINE)): digest_of(f) for f in sorted(files) if f.is_relative_to(ENGINE)}


def build(folder: Path) -> None:
    """Write the shared object and its manifest. For a process of its own: numba is set up for other processors.

    Raises:
        CannotBuild: no C compiler, or it failed.
    """
    command = compiler()
    found = kernels()
    manifest: dict[str, Any] = {"processor": PROCESSOR, "sources": sources(), "kernels": {}}
    signatures = {name: signature_of(one.py_func) for name, one in found.items()}
    objects = []
    for number, (name, one) in enumerate(found.items()):
        symbol = f"refract_{number}_{one.py_func.__name__.strip('_')}"
        arguments, returns = signatures[name]
        objects.append(_object(one, signatures[name], symbol))
        manifest["kernels"][name] = {
            "symbol": symbol,
            "arguments": [to_json(kind) for kind in arguments],
            "returns": None if returns is None else to_json(returns),
        }
    text = json.dumps(manifest, indent=1)
    manifest["key"] = hashlib.sha256(text.encode()).hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        _link(command, objects, manifest["key"], Path(place), Path(place) / OBJECT)
        shutil.move(Path(place) / OBJECT, folder / OBJECT)
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1), "utf-8")


def _object(one: Kernel, signature: Signature, symbol: str) -> bytes:
    """Machine code of one kernel, with `symbol` for a name."""
    import llvmlite.binding as llvm

    from . import jit

    types = tuple(jit.pointer_type.type_of(kind) for kind in signature.arguments)
    returns = jit.pointer_type.type_of(signature.returns) if signature.returns is not None else jit.NONE
    made = jit.ahead(one.py_func)
    made.compile(types)
    result = made.overloads[types]
    if result.signature.return_type != returns:
        raise TypeError(f"{symbol} says that it returns {returns}, and returns {result.signature.return_type}")
    module = result.library.module()
    entry = module.get_function(result.fndesc.llvm_func_name)
    for value in [*module.functions, *module.global_variables]:
        if not value.is_declaration and value.name != entry.name:
            value.linkage = "internal"
    entry.name = symbol
    entry.linkage = "external"
    target = llvm.Target.from_triple(llvm.get_process_triple())
    machine = target.create_target_machine(cpu=PROCESSOR, opt=3, reloc="pic", codemodel="default")
    code: bytes = machine.emit_object(module)
    return code


def _link(command: str, objects: list[bytes], key: str, place: Path, out: Path) -> None:
    names = []
    for number, code in enumerate(objects):
        names.append(str(place / f"{number}.o"))
        Path(names[-1]).write_bytes(code)
    source = place / "calls.c"
    calls = "".join(_CALL.replace("@NAME@", name) for name in _EXTERNALS)
    source.write_text(_SOURCE.replace("@KEY@", key) + calls, "ascii")
    options = ["-O2", "-fPIC", "-shared", "-s", "-Wl,--no-undefined", "-Wl,--as-needed"]
    ended = subprocess.run(
        [command, *options, "-o", str(out), str(source), *names, "-lm"], capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise CannotBuild(f"{command} failed: {ended.stderr.strip()}")


def main() -> None:
    """Build, in a process whose numba compiles for `PROCESSOR`."""
    if any(os.environ.get(name) != value for name, value in _ENVIRONMENT.items()):
        same_path = ["-P"] if sys.flags.safe_path else []  # the same package is to be found again
        command = [sys.executable, *same_path, "-m", f"{__package__}.build", *sys.argv[1:]]
        sys.exit(subprocess.run(command, env={**os.environ, **_ENVIRONMENT}, check=False).returncode)
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    try:
        build(folder)
    except CannotBuild as error:
        print(f"kernels are not compiled ahead of time: {error}")
        sys.exit(CANNOT)
    size = (folder / OBJECT).stat().st_size
    print(f"{len(kernels())} kernels compiled ahead of time, {size // 1000} kB")


if __name__ == "__main__":
    main()
