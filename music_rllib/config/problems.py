"""Problems of a configuration, in words for the person who wrote it.

Every problem names its place (file, line, dotted key), the rule and the value. Validation does not
stop at the first problem, so that a file is corrected in one round.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from music_rllib.envs.tasks import closest
from music_rllib.errors import BadInputError
from music_rllib.labels import SYMBOLS

if TYPE_CHECKING:
    from music_rllib.config.yaml_file import YamlFile

Model = TypeVar("Model", bound=BaseModel)

KeyPath = tuple[str | int, ...]
"""Keys and list positions that lead from the top of a document to one of its values."""


class Problem(NamedTuple):
    """One broken rule."""

    path: KeyPath
    rule: str
    """What must hold, and the value that breaks it: `must be > 0, got -1`."""


class ConfigError(BadInputError, ValueError):
    """A configuration that can't be used; the message has one line per problem."""

    def __init__(self, lines: Sequence[str]) -> None:
        """Hold `lines`, each of which names place, rule and value."""
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)


def shown(value: Any, limit: int = 60) -> str:
    """`value` for a message, about as the user wrote it, cut to `limit` characters."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except TypeError:
        text = repr(value)
    text = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(text, text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def same(first: Any, second: Any) -> bool:
    """Whether two values are equal as settings: 1 and 1.0 are, 1 and true are not."""
    if isinstance(first, bool) or isinstance(second, bool):
        return first is second
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return bool(first == second)


def lookup(document: Any, path: Iterable[str | int]) -> Any:
    """The value at `path`.

    Raises:
        LookupError: The document has none there.
    """
    for part in path:
        if isinstance(document, Mapping) or (
            isinstance(document, list | tuple) and isinstance(part, int)
        ):
            document = document[part]  # type: ignore[index]
        else:
            raise LookupError(part)
    return document


def unknown(key: str, known: Iterable[str]) -> str:
    """The rule that an unknown key breaks, with a suggestion from the `known` (dotted) keys."""
    names = list(known)
    field = key.rpartition(".")[2]
    field = SYMBOLS.get(field, field)
    meant = next((name for name in names if field in (name, name.rpartition(".")[2])), None)
    hint = closest(key, names) if meant is None else f" (did you mean {meant!r}?)"
    return f"is not a known setting{hint}"


def known_fields(model: type[BaseModel], path: KeyPath) -> Iterable[str]:
    """Names of the fields of the model at `path` below `model`; none where it is a union."""
    for part in path:
        field = model.model_fields.get(str(part))
        kind = field.annotation if field else None
        if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
            return ()
        model = kind
    return model.model_fields


def problems_of(
    error: ValidationError, document: Any, known: Callable[[KeyPath], Iterable[str]]
) -> list[Problem]:
    """Translate pydantic's error about `document` into problems, with paths relative to it.

    Args:
        known: Gives the known keys at a path, for suggestions.
    """
    problems = []
    for details in error.errors(include_url=False):
        if details["type"] == "too_short" and len(details["input"]) >= details["ctx"]["min_length"]:
            continue  # pydantic counts valid entries only; the invalid ones are reported
        path = _without_tags(details["loc"], document, missing=details["type"] == "missing")
        rule = _rule(details, path, known)
        if details["type"] == "value_error":
            path, rule = _more_precise(path, rule, document)
        problems.append(Problem(path, rule))
    return problems


def _without_tags(loc: KeyPath, document: Any, *, missing: bool) -> KeyPath:
    """The keys in pydantic's `loc`, which also names members of unions (tags)."""

    def readings(rest: KeyPath, here: Any) -> Iterator[tuple[KeyPath, list[str | int]]]:
        """Every way to split `rest` into keys of `here` and dropped tags."""
        if not rest:
            yield (), []
            return
        part = rest[0]
        with contextlib.suppress(LookupError):
            for path, dropped in readings(rest[1:], lookup(here, [part])):
                yield (part, *path), dropped
        if missing and len(rest) == 1 and isinstance(here, Mapping):
            yield (part,), []
        for path, dropped in readings(rest[1:], here):
            yield path, [part, *dropped]

    # A tag may equal a key: the right split drops the fewest parts, and preferably not the last.
    path, _ = min(readings(loc, document), key=lambda r: (len(r[1]), loc[-1:] != r[0][-1:]))
    return path


def _more_precise(path: KeyPath, rule: str, document: Any) -> tuple[KeyPath, str]:
    """Move the field that a rule about several fields begins with from the rule into the path."""
    subject, _, rest = rule.partition(" ")
    keys = tuple(subject.split("."))
    here = lookup(document, path)
    if rest.startswith("must ") and isinstance(here, Mapping) and keys[0] in here:
        return path + keys, rest
    return path, rule


_FIXED_RULES = {
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "dict_type": "must be a mapping of keys to values",
    "model_type": "must be a mapping of keys to values",
    "model_attributes_type": "must be a mapping of keys to values",
}
_COMPARISONS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}


def _rule(details: ErrorDetails, path: KeyPath, known: Callable[[KeyPath], Iterable[str]]) -> str:
    """The rule that a finding of pydantic is about."""
    kind, context, value = details["type"], details.get("ctx", {}), details["input"]
    hint = ""
    if kind == "extra_forbidden":
        return unknown(str(path[-1]), known(path[:-1]))
    if kind == "missing":
        return "must be given"
    if kind in _FIXED_RULES:
        rule = _FIXED_RULES[kind]
    elif kind in _COMPARISONS:
        sign, bound = _COMPARISONS[kind]
        rule = f"must be {sign} {context[bound]:g}"
    elif kind == "literal_error":
        rule = f"must be {context['expected']}"
        if isinstance(value, str):
            options = context["expected"].replace(" or ", ", ").split(",")
            hint = closest(value, [option.strip("' ") for option in options])
    elif kind == "too_short":
        rule = f"must have at least {context['min_length']} entries"
    elif kind == "string_too_short" and context["min_length"] == 1:
        rule = "must not be empty"
    elif kind == "string_pattern_mismatch":
        rule = "must be letters, digits, '.', '_' or '-', and begin with a letter or digit"
    elif kind == "value_error":
        rule = str(context["error"])
    else:
        rule = details["msg"].replace("Input should", "must", 1)
    if " got " in rule:
        return rule
    return f"{rule}, got {shown(value)}{hint}"


def from_json(kind: Any, value: Any) -> Any:
    """`value` as a `kind`, strictly: no text for numbers, no truth values for integers.

    Raises:
        pydantic.ValidationError: It isn't one.
    """
    # Through JSON, because strict mode takes lists for tuples only from there.
    adapter = TypeAdapter(kind)
    try:
        return adapter.validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        whole_numbers = [
            _without_tags(details["loc"], value, missing=False)
            for details in error.errors(include_url=False)
            if details["type"] in {"int_type", "int_from_float"}
            and isinstance(details["input"], float)
            and details["input"].is_integer()
        ]
        if not whole_numbers:
            raise
    # `1e6` is a float in YAML, and valid where an integer is asked for.
    document = json.loads(json.dumps([value]))
    for path in whole_numbers:
        *above, last = (0, *path)
        parent = lookup(document, above)
        parent[last] = int(parent[last])
    return adapter.validate_json(json.dumps(document[0]), strict=True)


class Findings:
    """The problems of a document so far; paths are relative to one place in it."""

    def __init__(self, path: KeyPath = (), problems: list[Problem] | None = None) -> None:
        self.path = path
        self.problems = [] if problems is None else problems
        """Problems of the whole document, with paths from its top."""

    def below(self, *keys: str | int) -> Findings:
        """The same problems, for paths relative to the value at `keys`."""
        return Findings((*self.path, *keys), self.problems)

    def add(self, path: KeyPath, rule: str) -> None:
        """Add a problem."""
        self.problems.append(Problem(self.path + path, rule))

    def validate(self, kind: type[Model], value: Any) -> Model | None:
        """`value` as a `kind`; None, with the problems added, if it isn't one."""
        try:
            return cast("Model", from_json(kind, value))
        except ValidationError as error:
            for problem in problems_of(error, value, lambda at: known_fields(kind, at)):
                self.add(problem.path, problem.rule)
            return None

    def forbid_repeats(self, values: Any, path: KeyPath) -> None:
        """Add a problem for each repeated entry of the list `values`; 1 and 1.0 are the same."""
        seen: set[tuple[bool, Any]] = set()
        others: list[Any] = []
        for position, value in enumerate(values if isinstance(values, list | tuple) else ()):
            if isinstance(value, str | int | float | None):
                # Equal numbers have equal hashes, whatever their type; 1 and true too.
                again = (isinstance(value, bool), value) in seen
                seen.add((isinstance(value, bool), value))
            else:
                again = any(same(value, other) for other in others)
                others.append(value)
            if again:
                self.add((*path, position), f"must not repeat, got {shown(value)} again")


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
