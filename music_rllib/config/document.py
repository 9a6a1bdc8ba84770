"""A sweep's settings as plain data, with the place where each value is written.

Three sources are laid over each other: a preset, the sweep's file, and the command line.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from music_rllib.config.problems import ConfigError, KeyPath, Problem, lookup, shown
from music_rllib.config.run_settings import SECTIONS
from music_rllib.config.yaml_file import YamlFile, read_yaml


class Place(NamedTuple):
    """The place of a value, for messages: `smoke.yaml:14` or `command line`."""

    source: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}" if self.line else self.source


COMMAND_LINE = Place("command line")


class Document:
    """A sweep's settings as plain data, with the place where each value is written."""

    def __init__(self, path: Path) -> None:
        """Read the sweep's file.

        Raises:
            ConfigError: It can't be read.
        """
        self.file = read_yaml(path)
        self.data: dict[str, Any] = _unshared(self.file.data)
        self._top = Place(path.name)
        self._places = _places_of(self.file)

    def place(self, path: KeyPath) -> Place:
        """The place of the value at `path`, or of the nearest existing value above it."""
        ends = range(len(path), 0, -1)
        return next((self._places[path[:n]] for n in ends if path[:n] in self._places), self._top)

    def lay_over(self, preset: YamlFile) -> None:
        """Put the settings of a preset below `defaults`, the fields of groups one by one."""
        defaults = self.data.get("defaults") or {}
        if not isinstance(defaults, dict):  # reported later
            return
        merged = preset.data | defaults
        for section in SECTIONS:
            lower, upper = preset.data.get(section), defaults.get(section)
            if isinstance(lower, dict) and (upper is None or isinstance(upper, dict)):
                merged[section] = lower | (upper or {})
        self.data["defaults"] = merged
        below = {("defaults", *path): place for path, place in _places_of(preset).items()}
        self._places = below | self._places

    def put(self, path: KeyPath, value: Any, place: Place = COMMAND_LINE) -> None:
        """Set the value at `path`; a group of settings keeps the fields that `value` lacks.

        Raises:
            ConfigError: A value on the way to it is not a mapping.
        """
        here: Any = self.data
        for position, (part, following) in enumerate(itertools.pairwise(path), start=1):
            if isinstance(here, dict) and here.get(part) is None:
                here[part] = {}
                self._places[path[:position]] = place
            here = find(here, (part,))
            if not isinstance(here, list if isinstance(following, int) else dict):
                key = self.key(path)
                rule = f"{key} must be inside of a mapping, got {shown(here)} at {part}"
                raise ConfigError([f"{place}: {rule}"])
        if (
            path[-1] in SECTIONS
            and isinstance(here.get(path[-1]), dict)
            and isinstance(value, dict)
        ):
            for name in value:
                self.put((*path, name), value[name], place)
            return
        here[path[-1]] = _unshared(value)
        self._places = {at: old for at, old in self._places.items() if at[: len(path)] != path}
        self._places[path] = place

    def key(self, path: KeyPath) -> str:
        """The dotted key of `path` as its author wrote it: `stages.finetune.tac.lr`.

        A stage has its name and another list's entry its position in brackets. A preset and the
        command line write settings without `defaults`.
        """
        if path[:1] == ("defaults",) and self.place(path).source != self._top.source:
            path = path[1:]
        text = ""
        for position, part in enumerate(path):
            name: Any = part
            if path[0] == "stages" and position == 1:
                with contextlib.suppress(LookupError):
                    name = lookup(self.data, (*path[:2], "name"))
            if isinstance(name, str):
                text += f".{name}" if text else name
            else:
                text += f"[{part}]"
        return text

    def lines(self, problems: Iterable[Problem]) -> list[str]:
        """One line per problem: place, key, rule and value. The command line comes first."""
        found = {
            (place.source != COMMAND_LINE.source, place.line, self._line(place, problem)): None
            for problem in problems
            for place in [self.place(problem.path)]
        }
        in_order = sorted(found, key=lambda one: one[:2])
        return list(dict.fromkeys(line for _, _, line in in_order))

    def _line(self, place: Place, problem: Problem) -> str:
        key, rule = self.key(problem.path), problem.rule
        separator = " " if rule.startswith(("must ", "is ", "has ", "needs ")) else ": "
        return f"{place}: {key}{separator if key else ''}{rule}"


def find(document: Any, path: KeyPath) -> Any:
    """The value at `path`; None if there is none."""
    try:
        return lookup(document, path)
    except LookupError:
        return None


def _places_of(file: YamlFile) -> dict[KeyPath, Place]:
    return {path: Place(file.path.name, line) for path, line in file.lines.items()}


def _unshared(value: Any) -> Any:
    """A copy with a value of its own at each use of a YAML alias, so that one place can change."""
    if isinstance(value, dict):
        return {key: _unshared(inner) for key, inner in value.items()}
    return [_unshared(inner) for inner in value] if isinstance(value, list) else value
