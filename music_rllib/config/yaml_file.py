"""Reads a YAML file strictly, with the line of each value.

Scalars follow the core schema of YAML 1.2. PyYAML follows YAML 1.1, where ``1e-3`` is text,
``3:6`` is the number 186 and ``010`` is eight. Keys must be text and may not repeat; PyYAML keeps
the last one.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import yaml

from music_rllib.config.problems import ConfigError, KeyPath
from music_rllib.limits import (
    MOST_DIGITS,
    MOST_NESTED,
    MOST_YAML_BYTES,
    MOST_YAML_VALUES,
    read_regular,
)


class YamlFile(NamedTuple):
    """A YAML file's content, and the line on which each of its values begins."""

    path: Path
    data: dict[str, Any]
    lines: Mapping[KeyPath, int]


def read_yaml(path: Path) -> YamlFile:
    """Read a YAML mapping.

    Raises:
        ConfigError: The file is missing, unreadable or not a valid YAML mapping.
    """
    try:
        text = read_regular(path, MOST_YAML_BYTES, follow=True).decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError([f"{path}: must be an existing file"]) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError([f"{path}: must be a readable YAML file: {reason}"]) from None
    try:
        data, lines = _parse(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise ConfigError([f"{path.name}{line}: {_rule(error)}"]) from None
    if not isinstance(data, dict):
        raise ConfigError([f"{path.name}: must be a mapping of keys to values at its top"])
    return YamlFile(path, data, MappingProxyType(lines))


def read_value(text: str) -> Any:
    """Read one YAML value.

    Raises:
        ValueError: It is invalid; the message names the rule.
    """
    try:
        return _parse(text[:MOST_YAML_BYTES])[0]
    except yaml.YAMLError as error:
        raise ValueError(_rule(error)) from None


def _parse(text: str) -> tuple[Any, dict[KeyPath, int]]:
    """The content of a text, and the lines of its values."""
    _check_white_space(text)
    loader = _StrictLoader(text.replace("\t", " "))  # in YAML 1.2 tabs can separate tokens
    root = loader.get_single_node()
    if root is None:
        return None, {}
    _check_values(root, {})
    lines = dict(_lines(root, ()))  # construction changes the nodes of mappings with `<<`
    return loader.construct_document(root), lines


def _rule(error: yaml.YAMLError) -> str:
    return f"must be valid YAML: {getattr(error, 'problem', None) or error}"


_QUOTED = re.compile(r"""'[^']*'|"(?:[^"\\]|\\.)*"|#.*""")
_LIKE_A_SPACE = re.compile(r"[^\S \t\r\n]|[\u200b\u2060\ufeff]")
_TAB_INDENTS = re.compile(r" *\t[ \t]*[^\s#]")


def _check_white_space(text: str) -> None:
    """Reject tabs that indent lines, and characters that only look like a space."""
    as_json = text.lstrip().startswith(("{", "["))
    for number, line in enumerate(text.split("\n")):
        rule = ""
        bare = _QUOTED.sub(lambda quoted: "." * len(quoted[0]), line)
        if found := _LIKE_A_SPACE.search(bare):
            name = f"U+{ord(found[0]):04X} ({unicodedata.name(found[0], 'a control character')})"
            place = f"column {found.start() + 1} has {name}"
            rule = f"{place}: replace it by a space, or quote the text"
        elif _TAB_INDENTS.match(line) and not as_json:
            rule = "a tab must not indent a line, use spaces"
        if rule:
            mark = yaml.Mark("", 0, number, 0, None, 0)
            raise yaml.scanner.ScannerError(None, None, rule, mark)


class _StrictLoader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2 and without repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Reject deep nesting before Python's own limit."""
        self._depth += 1
        if self._depth > MOST_NESTED:
            rule = f"must be nested at most {MOST_NESTED} levels deep"
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, rule, mark)
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Construct a value; report text that does not fit its tag (`!!int x`) with its line."""
        try:
            return super().construct_object(node, deep=deep)
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            tag = node.tag.rpartition(":")[2]
            raise _refusal(f"must be of its type, {tag}: {error}", node) from None

    def reject(self, node: yaml.Node) -> Any:
        """Reject a value that is not text, a number, a truth value, null, a list or a mapping."""
        raise _refusal(f"the tag {node.tag!r} is not allowed here", node)


class Dumper(yaml.SafeDumper):
    """Quotes text that is a number in YAML 1.2 but text in PyYAML, such as `12e4`."""


for _tag, _pattern, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?(?:0|[1-9][0-9_]*)", "-+0123456789"),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9_]*)(?:\.[0-9_]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("merge", r"<<", "<"),
):
    for _class in (_StrictLoader, Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), list(_first)
        )
for _tag in ("binary", "omap", "pairs", "set", "timestamp"):
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _StrictLoader.reject)


def _check_keys(node: yaml.MappingNode) -> None:
    seen = set()
    for key_node, _ in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            continue
        if not (isinstance(key_node, yaml.ScalarNode) and key_node.tag.endswith(":str")):
            raise _refusal("keys must be text", key_node)
        if key_node.value in seen:
            raise _refusal(f"key {key_node.value!r} must not repeat", key_node)
        seen.add(key_node.value)


def _check_values(node: yaml.Node, counts: dict[int, int | None]) -> int:
    """Count the values in `node`; the values of an alias count at each of its uses.

    Too many values are an error. Call it before construction, which copies the keys of a `<<` into
    its mapping. `counts` maps the id of a node to its count, or to None while it is being counted:
    each node is visited once, because nine nested aliases can stand for a thousand million values.
    """
    if id(node) in counts:
        count = counts[id(node)]
        if count is None:
            raise _refusal("an alias must not contain itself", node)
        return count
    counts[id(node)] = None
    total = 1
    if isinstance(node, yaml.MappingNode):
        _check_keys(node)
        total += sum(_check_values(inner, counts) for pair in node.value for inner in pair)
    elif isinstance(node, yaml.SequenceNode):
        total += sum(_check_values(value, counts) for value in node.value)
    elif node.tag.endswith(":int") and len(node.value) > MOST_DIGITS + 1:
        shown = f"{node.value[:8]}..."
        raise _refusal(f"a number must have at most {MOST_DIGITS} digits, got {shown}", node)
    if total > MOST_YAML_VALUES:
        raise _refusal(f"must have at most {MOST_YAML_VALUES} values, aliases included", node)
    counts[id(node)] = total
    return total


def _refusal(rule: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, rule, node.start_mark)


def _lines(node: yaml.Node, path: KeyPath) -> Iterator[tuple[KeyPath, int]]:
    """Yield paths and lines of all values below `node`."""
    inner: list[tuple[str | int, yaml.Node, yaml.Node]] = []
    if isinstance(node, yaml.MappingNode):
        inner = [(str(key.value), key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        inner = [(index, value, value) for index, value in enumerate(node.value)]
    for key, first, value in inner:
        yield (*path, key), first.start_mark.line + 1
        yield from _lines(value, (*path, key))
