"""How USD comes to know our schemas: at once where its Python is loaded already, else as soon as somebody loads it.

USD reads its table of schemas once, when the first stage of a process is opened or made. A program that imports
`refract_core` before that can `ApplyAPI("RefractMaterialAPI")`, and the import stays light: `pxr` is not loaded for it.
After that USD cannot be told any more; `ours` reads stages without its help then.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from ..schemas import FOLDER as _FOLDER

FOLDER: Path = _FOLDER
"""Holds plugInfo.json and generatedSchema.usda."""

_USD = "pxr.Usd"
"""No stage can be made from Python before this module is there."""


def register() -> None:
    """Tell USD where our schemas are. May be called any number of times."""
    from pxr import Plug

    Plug.Registry().RegisterPlugins(str(FOLDER))


def register_with_usd() -> None:
    """The same, without loading USD: now where it is loaded, else when it is."""
    if _USD in sys.modules:
        register()
    elif not any(isinstance(finder, _Waiting) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Waiting())


class _Waiting:
    """Finds nothing, but registers our schemas when `pxr.Usd` has been loaded, and is gone then.

    The variable PXR_PLUGINPATH_NAME would do it in a line, but every program started from here inherits it: one with
    another version of refract, or with a USD of its own, would be given these schemas without having asked.
    """

    def find_spec(self, name: str, _path: Sequence[str] | None, _target: ModuleType | None = None) -> ModuleSpec | None:
        if name != _USD:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                register()

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]  # the loader of this one module
        return spec
