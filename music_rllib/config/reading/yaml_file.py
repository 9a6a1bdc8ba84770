"""Strict reading of a YAML file: nothing in it is silently read as something else.

Scalars follow the core schema of YAML 1.2, not PyYAML's 1.1, where ``1e-3`` is text, ``3:6`` is
the number 186 and ``010`` is eight. Keys must be text and may not repeat; PyYAML keeps the last.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any, NamedTuple

import yaml

from music_rllib.config.problems import ConfigError, Path
from music_rllib.limits import (
    MOST_DIGITS,
    MOST_NESTED,
    MOST_YAML_BYTES,
    MOST_YAML_VALUES,
    read_regular,
)


class YamlFile(NamedTuple):
    """A document, and on which line each of its values begins."""

    path: FilePath
    text: str
    data: dict[str, Any]
    lines: Mapping[Path, int]

    def line(self, path: Path) -> int | None:
        """Where the value at `path`, or the nearest one above it that exists, begins."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path)

    def place(self, path: Path) -> str:
        """`smoke.yaml:14`, for messages."""
        line = self.line(path)
        return f"{self.path.name}:{line}" if line else self.path.name


def read_yaml(path: FilePath) -> YamlFile:
    """Read a YAML mapping.

    Raises:
        ConfigError: The file is missing, unreadable or not a sound YAML mapping.
    """
    try:
        text = read_regular(path, MOST_YAML_BYTES, follow=True).decode("utf-8")
    except FileNotFoundError:
        raise ConfigError([f"{path}: must be an existing file"]) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError([f"{path}: must be a readable YAML file: {reason}"]) from None
    try:
        loader = _StrictLoader(text)
        root = loader.get_single_node()
        lines: dict[Path, int] = {}
        if root is not None:
            _count(root, {})
        _note_lines(root, (), lines)
        data = loader.construct_document(root) if root is not None else None
    except yaml.YAMLError as error:
        raise ConfigError([f"{path.name}{_mark(error)}: {_complaint(error)}"]) from None
    if not isinstance(data, dict):
        raise ConfigError([f"{path.name}: must be a mapping of keys to values at its top"])
    return YamlFile(path, text, data, MappingProxyType(lines))


def read_value(text: str) -> Any:
    """One value by the same rules, as it stands behind a key.

    Raises:
        ValueError: It is none; says what it must be.
    """
    try:
        loader = _StrictLoader(text[:MOST_YAML_BYTES])
        root = loader.get_single_node()
        if root is None:
            return None
        _count(root, {})
        return loader.construct_document(root)
    except yaml.YAMLError as error:
        raise ValueError(_complaint(error)) from None


def _mark(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    return f":{mark.line + 1}" if mark else ""


def _complaint(error: yaml.YAMLError) -> str:
    problem = getattr(error, "problem", None)
    return f"must be valid YAML: {problem or error}"


class _StrictLoader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2 and without repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    _depth = _composed = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse what is nested too deeply, before Python does, and what is too much, in time."""
        self._depth += 1
        self._composed += 1
        rule = f"must be nested at most {MOST_NESTED} levels deep"
        if self._composed > MOST_YAML_VALUES:
            rule = f"must have at most {MOST_YAML_VALUES} values"
        if self._depth > MOST_NESTED or self._composed > MOST_YAML_VALUES:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, rule, mark)
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """As usual; what a tag promises and the text isn't (`!!int x`) is an error of the file."""
        try:
            return super().construct_object(node, deep=deep)
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            tag = node.tag.rpartition(":")[2]
            raise yaml.constructor.ConstructorError(
                None, None, f"must be of its type, {tag}: {error}", node.start_mark
            ) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            if not (isinstance(key_node, yaml.ScalarNode) and key_node.tag.endswith(":str")):
                raise yaml.constructor.ConstructorError(
                    None, None, "keys must be text", key_node.start_mark
                )
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key_node.value!r} must not repeat", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep=deep)

    def reject(self, node: yaml.Node) -> Any:
        """Refuse a value that is neither text, number, truth value, null, list nor mapping."""
        raise yaml.constructor.ConstructorError(
            None, None, f"the tag {node.tag!r} is not allowed here", node.start_mark
        )


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
    _StrictLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), list(_first)
    )
for _tag in ("binary", "omap", "pairs", "set", "timestamp"):
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _StrictLoader.reject)


def _count(node: yaml.Node, counts: dict[int, int | None]) -> int:
    """Values in `node`, those of an alias counted wherever it stands; refuse more than allowed.

    Each is looked at once: with nine aliases in a row the document would have a thousand million.
    """
    if id(node) in counts:
        found = counts[id(node)]
        if found is None:
            raise _refusal("an alias must not contain itself", node)
        return found
    counts[id(node)] = None
    total = 1
    if isinstance(node, yaml.MappingNode):
        total += sum(_count(key, counts) + _count(value, counts) for key, value in node.value)
    elif isinstance(node, yaml.SequenceNode):
        total += sum(_count(value, counts) for value in node.value)
    elif node.tag.endswith(":int") and len(node.value) > MOST_DIGITS + 1:
        shown = f"{node.value[:8]}..."
        raise _refusal(f"a number must have at most {MOST_DIGITS} digits, got {shown}", node)
    if total > MOST_YAML_VALUES:
        raise _refusal(f"must have at most {MOST_YAML_VALUES} values, aliases included", node)
    counts[id(node)] = total
    return total


def _refusal(rule: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, rule, node.start_mark)


def _note_lines(node: yaml.Node | None, path: Path, lines: dict[Path, int]) -> None:
    """Record where each value begins."""
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            inner = (*path, str(key_node.value))
            lines[inner] = key_node.start_mark.line + 1
            _note_lines(value_node, inner, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, value_node in enumerate(node.value):
            lines[*path, index] = value_node.start_mark.line + 1
            _note_lines(value_node, (*path, index), lines)
