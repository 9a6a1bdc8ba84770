"""Removes passwords and control characters from text and settings that leave the process.

Text from elsewhere (an environment's exception, a file, a server) passes `redact` before it is
written to a file, the terminal or MLflow, and also `printable` before the terminal.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache

MAX_PARAM_LENGTH = 6000
"""Longest value of an MLflow param, in characters."""

_NAMES = (
    r"password|passwd|passphrase|pwd|secret|token|credential|authorization|cookie"
    r"|(?:api|access|private|account)[_-]?key"
)
_SHORT_NAMES = r"(?<![A-Za-z])(?:pass|pw|auth)(?![A-Za-z])"
"""Parts of other words, so they must stand alone: `DB_PASS`, not `bypass`."""
_ITEM = r"""(?:'[^'\n]{0,999}'|"[^"\n]{0,999}"|[^'"()\[\]{}\n])"""
_VALUE = rf"""(?:
    [bfru]{{0,2}}(?:\"{{3}}.{{0,9999}}?(?:\"{{3}}|\Z)|\'{{3}}.{{0,9999}}?(?:\'{{3}}|\Z))
    |[bfru]{{0,2}}(?P<quote>\\?["'])(?:\\.|[^\\\n]){{0,9999}}?(?P=quote)
    |[(\[{{](?:{_ITEM}|[(\[{{]{_ITEM}{{0,999}}[)\]}}]){{1,999}}[)\]}}]
    |(?:(?:Bearer|Basic)\s+)?[^\s,;&)}}\]'"]+
)"""
"""A text in quotes, brackets (two levels) with their content, or a word."""
# Bounded repetitions: a long text must not take time quadratic in its length.
_SECRETS = tuple(
    re.compile(pattern, re.IGNORECASE | re.VERBOSE | re.DOTALL)
    for pattern in (
        # A private key in PEM format, and tokens that are known by their form.
        r"(?P<name>-----BEGIN\ [A-Z\ ]{0,40}PRIVATE\ KEY(?P<equals>[A-Z\ ]{0,9}-----))"
        r"(?:(?!-----).){0,20000}",
        r"""(?-i:(?<![\w\-])(?P<name>(?P<equals>))(?:(?:gh[opsru]|hf|npm)_[A-Za-z0-9]{30,}
        |github_pat_\w{22,}|glpat-[\w\-]{20,}|xox[a-z]-[\w\-]{10,}|(?:AKIA|ASIA)[A-Z0-9]{16}
        |AIza[\w\-]{35}|sk-(?:(?:ant|proj|svcacct)-[\w\-]{20,}|[A-Za-z0-9]{32,})
        |eyJ[\w\-]{8,}\.[\w\-]{8,}\.[\w\-]*)(?![A-Za-z0-9]))""",
        # user:password@ of a URI. A password can contain characters that end the host elsewhere.
        r"""(?P<name>[a-z][a-z0-9+.\-]{0,40}://)
        (?:[^/?\#@\s:'"\[]{0,999}:(?!\d{1,5}(?:[/?\#]|$))[^@\s]{0,999}@
        (?:(?:(?!://)[^@\s'"]){0,999}@){0,9}|[^/?\#\s'"]*@)""",
        # A parameter of a URI: ?sig=, &X-Amz-Signature=.
        rf"""(?P<name>[?&](?:[\w.\-]{{0,40}}?(?:{_NAMES})[\w.\-]{{0,40}}
        |(?:[\w.\-]{{0,40}}[_.\-])?(?:pass|pw|sig|signature))(?P<equals>=))[^&\s'"]*""",
        r"(?P<name>\bBearer(?P<equals>\s+))[\w.~+/=\-]+",
        # An option of a command: --password x.
        rf"""(?P<name>(?<![\w\-])--?(?:[\w\-]{{0,40}}?(?:{_NAMES})[\w\-]{{0,40}}
        |(?:[\w\-]{{0,40}}-)?(?:pass|pw|auth))(?P<equals>(?:["'],)?[ \t]+))(?!-){_VALUE}""",
        # A password after -p of sshpass, or attached to -p of MySQL, whose -p alone asks for it.
        rf"""(?-i:(?P<name>(?:\b(?:mysql|mariadb)[\w\-]{{0,20}}\b[^\n|;&]{{0,400}}?[\s"']-p(?!["']?[,\s\]])
        |\bsshpass["',\s]+(?:-v["',\s]+)?-p)(?P<equals>(?:["'],)?[ \t]{{0,9}}))){_VALUE}""",
        # A webhook of Slack or Discord, to which anyone who knows its address can post.
        r"""(?P<name>\b(?:hooks\.slack\.com/\w{1,20}|discord(?:app)?\.com/api/(?:v\d{1,3}/)?webhooks)
        /(?P<equals>))[\w/\-]+""",
        # A block of YAML: password: |
        rf"""(?P<name>(?:{_NAMES}|{_SHORT_NAMES})[\w\-]{{0,40}}["']?[ \t]{{0,9}}
        (?P<equals>:[ \t]{{1,9}}))[|>][\d+\-]{{0,2}}[ \t]{{0,9}}
        (?P<indent>\n[ \t]{{1,40}})[^\n]*(?:(?P=indent)[^\n]*)*""",
        # An assignment by = or :, perhaps with its value on the next line.
        rf"""(?P<name>(?:(?:{_NAMES})[\w\-]{{0,40}}
        |{_SHORT_NAMES}(?=\\?["']|\s{{0,9}}=|(?<=_pass):)|signature(?=\s{{0,9}}=))
        \\?["']?\s{{0,9}}(?:(?P<equals>:?=[=>]?)|:)[ \t]{{0,9}}
        (?:(?:[|>][+\-]?|\\)?\n[ \t]{{0,40}}(?![\w.\-]{{1,40}}[ \t]{{0,9}}[:=](?:\s|$)))?)
        {_VALUE}""",
    )
)
_CURL = re.compile(r"(?:\b(?:curl|wget)\b|--(?:proxy-)?user\b(?!-))(?:\\\n|[^\n])*", re.I)
"""A line from such a command or option on. `-u` of other commands takes no password."""
_CURL_USER = re.compile(
    r"""(?P<name>(?<![\w\-])(?:-[a-z]{0,9}?u|--(?:proxy-)?user\b(?!-))(?:["'],)?[ \t=]{0,9}["']?
    (?!\d+:\d+\b)[\w.@+\-]{1,99}(?P<equals>:))(?!//)[^\s'"]+""",
    re.IGNORECASE | re.VERBOSE,
)
"""A user and a password. Two numbers are ids of a user and a group."""
# C0 and C1 controls except line breaks and tabs, marks that change the direction of writing,
# invisible marks, and unpaired surrogates, which no terminal accepts.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)
_SECRET_KEY = re.compile(rf"{_NAMES}|{_SHORT_NAMES}", re.I)
_COUNTED_KEY = re.compile(r"tokens?", re.I)
"""A number under such a name is a count or an id."""
_KEYED_BY_TASK = ("environments", "per_task")
_CLASS = re.compile(r"[\w.]+:[\w./-]+")
"""A module and what it has: `token_world:TokenWorld-v0` has no secret."""
_NOT_IN_A_NAME = re.compile(r"[^\w./\- ]")


def redact(text: str) -> str:
    """``text`` without passwords.

    Removes ``user:password@`` in URIs, and values that are given (by ``=``, ``:``, in a URI's query
    or after an option of a command) to a name that contains ``password``, ``token``, ``secret``,
    ``api_key``, ``access_key``, ``credential`` or a similar word. Also private keys, passwords
    of ``curl -u user:``, ``mysql -p`` and ``sshpass -p``, addresses of webhooks, and tokens with a
    known beginning.
    """
    for pattern in _SECRETS:
        text = pattern.sub(_hidden, text)
    return _CURL.sub(lambda command: _CURL_USER.sub(_hidden, command[0]), text)


def _hidden(match: re.Match[str]) -> str:
    """The name with ``***`` for its value, in quotes after a colon to stay YAML or JSON."""
    groups = match.groupdict()
    if "equals" not in groups:
        return match["name"]
    if match["equals"] is not None:
        return f"{match['name']}***"
    quote = groups["quote"] or '"'
    return f"{match['name']}{quote}***{quote}"


def printable(text: str) -> str:
    """``text`` with control characters as JSON escapes, so that it cannot control a terminal."""
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def for_people(text: object) -> str:
    """An error or a warning without passwords and control characters."""
    return printable(redact(str(text)))


def without_secrets(
    settings: Mapping[str, object], *, of_tasks: bool = False, path: tuple[str, ...] = ()
) -> dict[str, object]:
    """A copy of nested ``settings`` with redacted text and without keys that name a secret.

    A key names a secret if it contains a word of `redact`. ``n_tokens: 4`` and the names of tasks,
    which are the keys if ``of_tasks``, are not secrets. ``path`` are the keys above.
    """
    return {
        str(key): _clean((*path, str(key)), value)
        for key, value in settings.items()
        if of_tasks or not _names_a_secret(str(key), counted=isinstance(value, int | float))
    }


# The runs of a sweep have the same names and nearly the same values of settings.
@lru_cache(maxsize=4096)
def _names_a_secret(key: str, *, counted: bool) -> bool:
    return _SECRET_KEY.search(_COUNTED_KEY.sub("", key) if counted else key) is not None


_redacted = lru_cache(maxsize=4096)(redact)


def _clean(path: tuple[str, ...], value: object) -> object:
    if isinstance(value, Mapping):
        return without_secrets(value, of_tasks=path[-1] in _KEYED_BY_TASK, path=path)
    if isinstance(value, (list, tuple)):
        return [_clean((*path, ""), item) for item in value]
    if not isinstance(value, str):
        return value
    if _names_a_class(path) and _CLASS.fullmatch(value):
        return ":".join(map(_redacted, value.split(":")))
    return _redacted(value)


def _names_a_class(path: tuple[str, ...]) -> bool:
    """Whether a setting is an environment's id or an intrinsic reward."""
    if "env_kwargs" in path:
        return False
    keys = [key.rpartition(":")[2] for key in path if key]  # without the positions in lists
    of_reward = "intrinsic.reward" in keys or keys[-2:] == ["intrinsic", "reward"]
    return of_reward or (path[-1] == "env_id" and path[0] in ("environments", "task"))


def flat_params(settings: Mapping[str, object]) -> dict[str, str]:
    """Nested ``settings`` as MLflow params: dotted names, scalars as text.

    A list is one param (JSON text). Secrets, lists of records outside of the settings of an
    intrinsic reward, and values above ``MAX_PARAM_LENGTH`` characters are omitted: the whole
    configuration is an artifact anyway.
    """
    flat = {}
    for name, value in _leaves(without_secrets(settings), ""):
        if isinstance(value, list):
            own = name.startswith("intrinsic.settings.")  # a grid can vary them
            if any(isinstance(item, Mapping) for item in value) and not own:
                continue
            value = json.dumps(value, default=str)
        if len(text := str(value)) <= MAX_PARAM_LENGTH:
            flat[_NOT_IN_A_NAME.sub("_", name)[:250]] = text
    return flat


def _leaves(settings: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    """Dotted names and values of nested settings."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
