"""The page of `/docs`: the OpenAPI document for people, readable without a network.

FastAPI's own page loads its script and style sheet from a CDN, so it stays blank behind a firewall.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from html import escape
from typing import Any

STYLE = """\
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;
color:#1b1b1b;background:#fff}
h2{margin-top:2.5rem;border-top:1px solid #ccc;padding-top:1rem}
code,pre{font:14px/1.45 ui-monospace,monospace}
pre{background:#f4f4f4;padding:.8rem;overflow-x:auto;white-space:pre-wrap;overflow-wrap:anywhere}
td,th{text-align:left;padding:.1rem 1.5rem .1rem 0;vertical-align:top}
"""


def docs_page(document: dict[str, Any], base_url: str) -> str:
    """HTML that loads nothing: no script, no image, no style sheet.

    Args:
        document: The OpenAPI document.
        base_url: Address of the service, for the commands to copy.
    """
    info = document["info"]
    base = base_url.rstrip("/")
    parts = [
        f"<h1>{escape(info['title'])} {escape(info['version'])}</h1>",
        f"<p>{escape(info.get('summary', ''))}</p>",
        *(f"<p>{_text(part)}</p>" for part in info.get("description", "").strip().split("\n\n")),
        '<p>The OpenAPI document, for programs: <a href="openapi.json">/openapi.json</a></p>',
    ]
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            parts += _operation(method.upper(), path, operation, base)
    parts += _schemas(document.get("components", {}).get("schemas", {}))
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{escape(info['title'])}</title>\n<style>\n{STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _text(markdown: str) -> str:
    """HTML of a description, whose only Markdown is `code`."""
    pieces = escape(" ".join(markdown.split())).split("`")
    return "".join(
        f"<code>{piece}</code>" if number % 2 else piece for number, piece in enumerate(pieces)
    )


def _operation(method: str, path: str, operation: dict[str, Any], base: str) -> Iterator[str]:
    yield f"<h2><code>{method} {escape(path)}</code></h2>"
    yield f"<p>{_text(operation.get('description', ''))}</p>"
    command = ["curl", "-s", f"{base}{path}"]
    if operation.get("security"):
        yield "<p>The token must be sent as <code>Authorization: Bearer TOKEN</code>.</p>"
        command += ["-H", "Authorization: Bearer TOKEN"]
    example = _example(operation)
    if example is not None:
        command += ["-H", "Content-Type: application/json", "-d", json.dumps(example)]
    yield f"<pre>{escape(shlex.join(command))}</pre>"
    yield "<table><tr><th>status</th><th>answer</th></tr>"
    for status, response in operation["responses"].items():
        yield f"<tr><td>{escape(status)}</td><td>{escape(_answer(response))}</td></tr>"
    yield "</table>"


def _example(operation: dict[str, Any]) -> Any:
    """A valid body; None if the operation has none."""
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    for example in content.get("examples", {}).values():
        return example["value"]
    return None


def _answer(response: dict[str, Any]) -> str:
    """A response's description and the name of its schema."""
    schema = response.get("content", {}).get("application/json", {}).get("schema", {})
    name = schema.get("$ref", "").rpartition("/")[2]
    return f"{response['description']}{f': {name}' if name else ''}"


def _schemas(schemas: dict[str, Any]) -> Iterator[str]:
    if schemas:
        yield "<h2>Bodies</h2>"
    for name, schema in schemas.items():
        text = json.dumps(schema, indent=1)
        yield f"<details><summary><code>{escape(name)}</code></summary>"
        yield f"<pre>{escape(text)}</pre></details>"
