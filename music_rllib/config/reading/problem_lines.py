"""The mistakes of a sweep's file as lines: where, which key, which rule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from music_rllib.config.problems import Path as KeyPath
from music_rllib.config.problems import Problem, lookup
from music_rllib.config.reading.yaml_file import YamlFile


def problem_lines(
    problems: Iterable[Problem],
    file: YamlFile,
    document: Any,
    options: Mapping[str, Any],
    origins: Mapping[KeyPath, str] = MappingProxyType({}),
) -> list[str]:
    """One line per different mistake, in the order of the file, those of the command line first."""

    def line(problem: Problem) -> str:
        if problem.path and problem.path[0] in options:
            return f"--{problem.path[0]} {problem.rule}"
        place, key = file.place(problem.path), _dotted(problem.path, document)
        for length in range(len(problem.path), 0, -1):
            if problem.path[:length] in origins:
                place, key = "command line", origins[problem.path[:length]]
                key += "".join(
                    f"[{part}]" if isinstance(part, int) else f".{part}"
                    for part in problem.path[length:]
                )
                break
        else:
            inside = (path[: len(problem.path)] for path in origins)
            if problem.path not in file.lines and problem.path in inside:
                place = "command line"
        separator = " " if problem.rule.startswith(("must ", "is ", "has ", "needs ")) else ": "
        return f"{place}: {key}{separator if key else ''}{problem.rule}"

    in_order = sorted(_merged(problems), key=lambda problem: file.line(problem.path) or 0)
    return list(dict.fromkeys(line(problem) for problem in in_order))


def _merged(problems: Iterable[Problem]) -> list[Problem]:
    """The values of one list in a grid that break the same rule are one mistake."""
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
    """`stages.finetune.tac.lr`: stages by name, positions in other lists in brackets."""
    text = ""
    for position, part in enumerate(path):
        if isinstance(part, str):
            text += f".{part}" if text else part
            continue
        try:
            name = lookup(document, (*path[: position + 1], "name"))
        except LookupError:
            name = None
        by_name = path[0] == "stages" and position == 1 and isinstance(name, str)
        text += f".{name}" if by_name else f"[{part}]"
    return text
