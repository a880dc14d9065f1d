"""The words the page knows; /docs, which has a viewer of the OpenAPI document, and its text where scripts are off; and
a page per problem type."""

from __future__ import annotations

import json
from html import escape
from typing import Any

from refract_core.models import MODELS, Model
from refract_core.settings import SCREEN_METHODS, TIERS

from .limits import Limits, table
from .problems import KINDS

_HEAD = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><link rel="icon" type="image/svg+xml" href="/static/icon.svg">
<link rel="stylesheet" href="/static/page.css"><main>
<h1>{title}</h1>
"""


_VIEWER = """<link rel="stylesheet" href="static/swagger/swagger-ui.css"><div id="viewer"></div>
<script src="static/swagger/swagger-ui-bundle.js"></script><script src="static/viewer/docs.js"></script>"""


def words() -> str:
    """The engine's words as a module of the page's script, `/static/words.js`: nothing is written there twice."""
    told = {
        "TIERS": TIERS, "SCREENS": SCREEN_METHODS, "MODELS": MODELS,
        "MODEL_HELP": {model.token: model.row.help for model in Model},
    }  # fmt: skip
    lines = [f"export const {name} = {json.dumps(value)};" for name, value in told.items()]
    return "\n".join(["// The engine's own words.", "", *lines, ""])


def problem_page(slug: str) -> str:
    kind = KINDS[slug]
    return f"{_HEAD.format(title=escape(kind.title))}<p>Status {kind.status}. {escape(kind.about)}</p></main></html>"


def docs_page(document: dict[str, Any], limits: Limits) -> str:
    """Every operation, to be read and tried, and every limit and problem type."""
    parts = [_HEAD.format(title="refract over HTTP"), '<p>As a document: <a href="openapi.json">openapi.json</a>.</p>',
             "<pre>curl -F stage=@glass.usdz http://127.0.0.1:8000/v1/render -o glass.png</pre>", _VIEWER]  # fmt: skip
    parts.append(f"<noscript><p>{escape(document['info']['description'])}</p>")
    if "securitySchemes" in document["components"]:
        parts.append("<p>This service asks for a token: send <code>Authorization: Bearer TOKEN</code>.</p>")
    for path, operations in document["paths"].items():
        for method, one in operations.items():
            parts.append(f"<h2><code>{method.upper()} {escape(path)}</code></h2>")
            parts.append(f"<p>{escape(one.get('description') or one.get('summary', ''))}</p>")
            for header in one.get("parameters", ()):
                if header["in"] in ("header", "query"):
                    parts.append(f"<p><code>{escape(header['name'])}</code>: {escape(header['description'])}</p>")
            done = {code: text for code, text in one["responses"].items() if code < "4"}
            answers = ", ".join(f"{code} {escape(text['description'])}" for code, text in done.items())
            refusals = ", ".join(code for code in one["responses"] if code not in done)
            parts.append(f"<p>Answers: {answers}; problems: {refusals}</p>")
            for media, content in one.get("requestBody", {}).get("content", {}).items():
                schema = escape(json.dumps(content["schema"], indent=1))
                parts.append(f"<details><summary>{escape(media)}</summary><pre>{schema}</pre></details>")
    parts.append('</noscript><h2 id="limits">Limits</h2><table><tr><th>name<th>value<th>unit<th>meaning<th>environment')
    for row in table(limits):
        cells = (row["name"], row["value"], row["unit"], row["meaning"], row["variable"])
        parts.append("<tr>" + "".join(f"<td>{escape(str(cell))}" for cell in cells))
    parts.append("</table><h2>Problems</h2><dl>")
    for slug, kind in KINDS.items():
        parts.append(f'<dt><a href="/problems/{slug}">{slug}</a> ({kind.status})<dd>{escape(kind.title)}')
    return "\n".join([*parts, "</dl></main></html>"])
