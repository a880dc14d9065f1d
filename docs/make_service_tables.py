"""Put the tables of models, limits and problems into docs/service.md: `python docs/make_service_tables.py`."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from refract_core.models import Model
from service.limits import Limits
from service.problems import KINDS

PAGE = Path(__file__).with_name("service.md")
_UNITS = {30: "GiB", 20: "MiB", 10: "KiB"}


def _models() -> str:
    rows = ["| model | what light goes through behind the surface |", "|---|---|"]
    return "\n".join([*rows, *(f"| `{model.token}` | {model.row.help} |" for model in Model)])


def _limits() -> str:
    rows = ["| name | default | unit | of what |", "|---|---|---|---|"]
    for one in fields(Limits):
        value, unit = int(str(one.default)), one.metadata["unit"]
        if unit == "bytes":
            unit += next((f" ({value >> shift} {name})" for shift, name in _UNITS.items() if value >> shift), "")
        rows.append(f"| `{one.name}` | {value} | {unit} | {one.metadata['meaning']} |")
    return "\n".join(rows)


def _problems() -> str:
    rows = ["| type | status | what happened | what to do |", "|---|---|---|---|"]
    rows += [f"| `{slug}` | {kind.status} | {kind.title} | {kind.about} |" for slug, kind in KINDS.items()]
    return "\n".join(rows)


def page(text: str) -> str:
    """The page as it should be: what stands between two comments of one name is made anew."""
    for name, table in (("models", _models()), ("limits", _limits()), ("problems", _problems())):
        marked = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end of {name} -->)", re.DOTALL)
        text, count = marked.subn(lambda found, table=table: found[1] + table + found[2], text)  # type: ignore[misc]
        assert count == 1, f"{PAGE.name} has no place for the table of {name}"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
