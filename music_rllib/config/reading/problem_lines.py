"""Problems of a sweep's file as lines of text: place, key, rule."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from music_rllib.config.problems import KeyPath, Problem, lookup
from music_rllib.config.reading.yaml_file import YamlFile


def problem_lines(
    problems: Iterable[Problem],
    file: YamlFile,
    document: Any,
    options: Mapping[str, Any],
    origins: Mapping[KeyPath, str] = MappingProxyType({}),
) -> list[str]:
    """One line for each different problem, those of the command line first, then by line.

    Args:
        document: The content of `file` with the values of the command line.
        options: Values of options like `--name`, by key.
        origins: Place of a value to the `KEY` of the command line that it comes from.
    """

    def line(problem: Problem) -> str:
        path, rule = problem
        if path and path[0] in options:
            return f"--{path[0]} {rule}"
        place, key = file.place(path), _dotted(path, document)
        above = next((path[:end] for end in range(len(path), 0, -1) if path[:end] in origins), None)
        if above is not None:
            rest = (f"[{k}]" if isinstance(k, int) else f".{k}" for k in path[len(above) :])
            place, key = "command line", origins[above] + "".join(rest)
        elif path not in file.lines and any(path == origin[: len(path)] for origin in origins):
            place = "command line"
        separator = " " if rule.startswith(("must ", "is ", "has ", "needs ")) else ": "
        return f"{place}: {key}{separator if key else ''}{rule}"

    in_order = sorted(_merged(problems), key=lambda problem: file.line(problem.path) or 0)
    return list(dict.fromkeys(line(problem) for problem in in_order))


def _merged(problems: Iterable[Problem]) -> list[Problem]:
    """The problems, where those of values in one list of a grid that break one rule are one."""
    groups: dict[tuple[KeyPath, str], list[Problem]] = {}
    for problem in dict.fromkeys(problems):
        path, rule = problem.path, problem.rule
        if len(path) > 3 and path[2] == "grid" and isinstance(path[-1], int):
            path, rule = path[:-1], rule.partition(", got ")[0]
        groups.setdefault((path, rule), []).append(problem)
    return [
        group[0] if len(group) == 1 else Problem(path, rule + _got(group))
        for (path, rule), group in groups.items()
    ]


def _got(group: Iterable[Problem]) -> str:
    values = ", ".join(problem.rule.partition(", got ")[2] for problem in group)
    return f", got {values}" if values.strip(", ") else ""


def _dotted(path: KeyPath, document: Any) -> str:
    """`stages.finetune.tac.lr`: a stage by its name, positions in other lists in brackets."""
    text = ""
    for position, part in enumerate(path):
        name: Any = part
        if path[0] == "stages" and position == 1:
            with contextlib.suppress(LookupError):
                name = lookup(document, (*path[:2], "name"))
        if isinstance(name, str):
            text += f".{name}" if text else name
        else:
            text += f"[{part}]"
    return text
