"""Where the schemas are, and what other programs have to be told so that they know them."""

from __future__ import annotations

import json
import shlex

from ..schemas import APPLIED, TYPED
from ..usd.registering import FOLDER

VARIABLE = "PXR_PLUGINPATH_NAME"
"""Where every program with a USD in it looks for plugins when it starts (OpenUSD, `Plug`)."""


def folder() -> str:
    """The folder with plugInfo.json in it."""
    return str(FOLDER)


def export_line() -> str:
    """For a shell, before a program is started; what is in the variable already stays."""
    return f"export {VARIABLE}={shlex.quote(folder())}${{{VARIABLE}:+:${VARIABLE}}}"


def houdini_package() -> str:
    """What a file in Houdini's folder of packages says."""
    return json.dumps({"env": [{VARIABLE: {"method": "append", "value": folder()}}]})


def registering_line() -> str:
    """For a program whose Python runs before its first stage is opened, such as an extension of Kit."""
    return f"from pxr import Plug; Plug.Registry().RegisterPlugins({folder()!r})"


def to_text() -> str:
    """All of it, for a person."""
    names = ", ".join((*APPLIED, *TYPED))
    return f"""{names}
are in {folder()}

usdview, usdrecord and other programs started from a shell (in ~/.profile for all that you start):
  {export_line()}

Houdini: the same line before it starts, or a file $HOUDINI_USER_PREF_DIR/packages/refract.json with
  {houdini_package()}

Omniverse: the same line before Kit starts, or in an extension that is loaded before omni.usd
  {registering_line()}"""
