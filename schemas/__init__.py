"""USD schemas of the refract renderer: data files, and the one call that makes USD know them.

Other programs need no Python of ours: they find the schemas when PXR_PLUGINPATH_NAME names this folder.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parent
APPLIED = ("RefractMaterialAPI", "RefractProbeAPI", "RefractSettingsAPI")
TYPED = ("RefractProbe", "RefractPlanarProbe")


def register() -> None:
    """Make the schemas known to USD. May be called any number of times; must be called before any stage is opened.

    `import refract_core` registers too, as soon as USD is loaded; this call is for those who want to be told that it is
    too late.
    USD reads its table of schemas once, when a stage is first opened or made. This call reads it too, to be sure, so
    other packages that bring schemas have to be imported before it.

    Raises:
        RuntimeError: USD had read its table before, without these schemas.
    """
    from pxr import Plug, Usd

    Plug.Registry().RegisterPlugins(str(FOLDER))
    known = Usd.SchemaRegistry()
    missing = [name for name in APPLIED if known.FindAppliedAPIPrimDefinition(name) is None]
    missing += [name for name in TYPED if known.FindConcretePrimDefinition(name) is None]
    if missing:
        raise RuntimeError(
            f"USD does not know the schemas {', '.join(missing)}: a stage was opened or made in this process before "
            "schemas.register() was called, and USD reads its schemas only once. Call schemas.register() before the "
            f"first stage, or start the process with PXR_PLUGINPATH_NAME={FOLDER}"
        )
