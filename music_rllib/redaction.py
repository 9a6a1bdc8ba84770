"""What may leave the process: settings as flat params, and text without passwords.

Every text that comes from elsewhere (an environment's exception, a file, a server) and goes to a
file, the terminal or MLflow goes through `redact`, and to the terminal through `printable` as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping

MAX_PARAM_LENGTH = 6000
"""MLflow's limit for the value of a param, in characters."""

_USER_INFO = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.\-]{0,40}://)[^/?#\s'\"]*@")
_QUERY_SECRET = re.compile(
    r"(?P<name>[?&](?:password|passwd|pwd|sslpassword|token|secret|access_key)=)[^&\s'\"]*", re.I
)
_ASSIGNED_SECRET = re.compile(
    # Bounded repetitions: a long text must not take time quadratic in its length.
    r"""(?P<name>(?:password|passwd|pwd|secret|token|api_?key|access_?key|credential)[\w-]{0,40}
        \\?["']?\s{0,9})
    (?:(?P<equals>=\s{0,9})|(?P<colon>:\s{0,9}))
    (?:\\?(?P<quote>["']).{0,9999}?(?P=quote)|(?:Bearer\s+)?[^\s,;&)}\]'"]+)""",
    re.IGNORECASE | re.VERBOSE,
)
_BEARER = re.compile(r"(?P<name>\bBearer\s+)[\w.~+/=-]+")
# C0 and C1 controls but line breaks and tabs, marks that change the direction of writing or hide,
# and halves of characters, which no terminal can be given.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)
_SECRET_KEY = re.compile(r"password|passwd|secret|token|api_?key|credential", re.I)
_NOT_IN_A_NAME = re.compile(r"[^\w./\- ]")


def redact(text: str) -> str:
    """``text`` without passwords.

    Left out are ``user:password@`` in URIs, and what is assigned to a name that contains
    ``password``, ``token``, ``secret``, ``api_key``, ``access_key`` or ``credential``: by ``=``,
    ``:`` or in a URI's query.
    """
    text = _USER_INFO.sub(lambda match: match["scheme"], text)
    text = _QUERY_SECRET.sub(lambda match: match["name"] + "***", text)
    text = _BEARER.sub(lambda match: match["name"] + "***", text)
    return _ASSIGNED_SECRET.sub(_hidden, text)


def _hidden(found: re.Match[str]) -> str:
    """In quotes after a colon, to stay YAML and JSON."""
    if found["equals"] is not None:
        return f"{found['name']}{found['equals']}***"
    quote = found["quote"] or '"'
    return f"{found['name']}{found['colon']}{quote}***{quote}"


def printable(text: str) -> str:
    """``text`` with control characters as JSON's escapes: a file can't command a terminal."""
    return _UNPRINTABLE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def for_people(text: object) -> str:
    """An error or a remark as it may be shown: without passwords and control characters."""
    return printable(redact(str(text)))


def without_secrets(settings: Mapping[str, object]) -> dict[str, object]:
    """A copy of nested ``settings`` with redacted URIs and without keys that name a secret.

    A key names a secret where it contains ``password``, ``token``, ``secret``, ``api_key`` or
    ``credential``. The input is not changed.
    """
    return {
        str(key): _clean(value)
        for key, value in settings.items()
        if not _SECRET_KEY.search(str(key))
    }


def _clean(value: object) -> object:
    if isinstance(value, Mapping):
        return without_secrets(value)
    if isinstance(value, (list, tuple)):
        return [_clean(item) for item in value]
    return redact(value) if isinstance(value, str) else value


def flat_params(settings: Mapping[str, object]) -> dict[str, str]:
    """Nested ``settings`` as MLflow params: dotted names, scalars as text.

    A list of scalars is one param (JSON text). Left out, since the whole configuration is an
    artefact anyway: secrets, lists of records, and values above ``MAX_PARAM_LENGTH`` characters.
    """
    flat = {}
    for name, value in _leaves(without_secrets(settings), ""):
        text = _param_text(value)
        if text is not None and len(text) <= MAX_PARAM_LENGTH:
            flat[_NOT_IN_A_NAME.sub("_", name)[:250]] = text
    return flat


def _leaves(settings: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _param_text(value: object) -> str | None:
    if isinstance(value, list):
        return None if any(isinstance(item, (Mapping, list)) for item in value) else _json(value)
    return str(value)


def _json(value: object) -> str:
    return json.dumps(value, default=str)
