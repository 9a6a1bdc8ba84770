"""Problems of a configuration: the broken rule, its place in the document, and the value.

Validation does not stop at the first problem, so that a file can be corrected in one round.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from music_rllib.envs.tasks import closest
from music_rllib.errors import BadInputError, shorten
from music_rllib.names import SYMBOLS

Model = TypeVar("Model", bound=BaseModel)

KeyPath = tuple[str | int, ...]
"""Keys and list positions that lead from the top of a document to one of its values."""


class Problem(NamedTuple):
    """One broken rule."""

    path: KeyPath
    rule: str
    """The rule and the value that breaks it: `must be > 0, got -1`."""


class ConfigError(BadInputError, ValueError):
    """An invalid configuration; the message has one line per problem."""

    def __init__(self, lines: Sequence[str]) -> None:
        """Take `lines` that name place, rule and value."""
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)


def shown(value: Any, limit: int = 60) -> str:
    """`value` for a message, about as the user wrote it, cut to `limit` characters."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except TypeError:
        text = repr(value)
    text = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(text, text)
    return shorten(text, limit)


def same(first: Any, second: Any) -> bool:
    """Whether two values are equal as settings: 1 and 1.0 are, 1 and true are not."""
    return bool(_comparable(first) == _comparable(second))


def _comparable(value: Any) -> Any:
    """A hashable form of plain data, which is equal for values that are equal as settings."""
    if isinstance(value, Mapping):
        return frozenset((key, _comparable(inner)) for key, inner in value.items())
    if isinstance(value, list | tuple):
        return tuple(map(_comparable, value))
    return (bool, value) if isinstance(value, bool) else value


def lookup(document: Any, path: Iterable[str | int]) -> Any:
    """The value at `path`.

    Raises:
        LookupError: The document has no value there.
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
    if "." in key and key in names:  # a dotted setting where groups are written
        top, *rest = key.split(".")
        inner = functools.reduce(lambda text, part: f"{{{part}: {text}}}", reversed(rest), "...")
        return f"is not a known setting here (did you mean '{top}: {inner}'?)"
    field = SYMBOLS.get(field, field)
    meant = next((name for name in names if field in (name, name.rpartition(".")[2])), None)
    hint = closest(key, names) if meant is None else f" (did you mean {meant!r}?)"
    return f"is not a known setting{hint}"


def known_fields(model: type[BaseModel], path: KeyPath) -> Iterable[str]:
    """Names of the fields at `path` below `model`; empty if the type is a union."""
    for part in path:
        field = model.model_fields.get(str(part))
        kind = field.annotation if field else None
        if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
            return ()
        model = kind
    return model.model_fields


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
        """Add a problem unless it is known."""
        problem = Problem(self.path + path, rule)
        if problem not in self.problems:
            self.problems.append(problem)

    def validate(self, kind: type[Model], value: Any) -> Model | None:
        """Validate `value` as a `kind`; add the problems and return None if it is invalid."""
        try:
            return from_json(kind, value)
        except ValidationError as error:
            for problem in problems_of(error, value, kind):
                self.add(problem.path, problem.rule)
            return None

    def forbid_repeats(self, values: Any, path: KeyPath) -> None:
        """Add a problem for each repeated entry of the list `values`; 1 and 1.0 are the same."""
        seen = set()
        for position, value in enumerate(values if isinstance(values, list | tuple) else ()):
            if _comparable(value) in seen:
                self.add((*path, position), f"must not repeat, got {shown(value)} again")
            seen.add(_comparable(value))


def from_json(kind: type[Model], value: Any) -> Model:
    """Validate `value` strictly: text is not a number, and a truth value is not an integer.

    Raises:
        pydantic.ValidationError: It is invalid.
    """
    # Through JSON, because only there strict mode accepts lists for tuples.
    try:
        return kind.model_validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        whole_numbers = [
            _without_tags(details["loc"], value)
            for details in error.errors(include_url=False)
            if details["type"] in {"int_type", "int_from_float"}
            and isinstance(details["input"], float)
            and details["input"].is_integer()
        ]
        if not whole_numbers:
            raise
    # `1e6` is a float in YAML, and valid where an integer is needed.
    document = json.loads(json.dumps(value))
    for path in whole_numbers:
        parent = lookup(document, path[:-1])
        parent[path[-1]] = int(parent[path[-1]])
    return kind.model_validate_json(json.dumps(document), strict=True)


def problems_of(error: ValidationError, document: Any, kind: type[BaseModel]) -> Iterator[Problem]:
    """Translate pydantic's error about `document` as a `kind` into problems.

    Yields:
        Problems, with paths relative to `document`.
    """
    for details in error.errors(include_url=False):
        if details["type"] == "too_short" and len(details["input"]) >= details["ctx"]["min_length"]:
            continue  # pydantic counts valid entries only; the invalid ones are reported
        path, rule = _without_tags(details["loc"], document), _rule(details)
        if details["type"] == "extra_forbidden":
            *section, key = map(str, path)
            known = (".".join([*section, name]) for name in known_fields(kind, path[:-1]))
            rule = unknown(".".join([*section, key]), known)
        elif details["type"] == "missing":
            path = (*path, details["loc"][-1])
        elif details["type"] == "value_error":
            path, rule = _more_precise(path, rule, document)
        yield Problem(path, rule)


def _without_tags(loc: KeyPath, document: Any) -> KeyPath:
    """The keys in pydantic's `loc` that exist in `document`, without the tags of unions.

    No tag of a settings model may equal a key of the mapping that it is the tag of.
    """
    path: KeyPath = ()
    for part in loc:
        try:
            document = lookup(document, [part])
        except LookupError:
            continue
        path = (*path, part)
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
    "string_pattern_mismatch": (
        "must be letters, digits, '.', '_' or '-', and begin with a letter or digit"
    ),
    "string_too_short": "must not be empty",
    "missing": "must be given",
}
_WORDS = re.compile(r"[\w.-]+(, ?[\w.-]+)*")
_COMPARISONS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}


def _rule(details: ErrorDetails) -> str:
    """The rule and the value of one of pydantic's errors."""
    kind, context, value = details["type"], details.get("ctx", {}), details["input"]
    hint = ""
    if kind in _FIXED_RULES:
        rule = _FIXED_RULES[kind]
        if rule == "must be a list" and isinstance(value, str) and _WORDS.fullmatch(value):
            hint = f" (did you mean '[{value}]'?)"
    elif kind in _COMPARISONS:
        sign, bound = _COMPARISONS[kind]
        rule = f"must be {sign} {context[bound]:g}"
    elif kind == "literal_error":
        rule = f"must be {context['expected']}"
        if isinstance(value, str):
            options = context["expected"].replace(" or ", ", ").split(",")
            hint = closest(value, [option.strip("' ") for option in options])
    elif kind == "too_short":
        least = context["min_length"]
        rule = "must not be empty" if least == 1 else f"must have at least {least} entries"
    elif kind == "too_long":
        rule = f"must have at most {context['max_length']:,} entries"
    elif kind == "value_error":
        rule = str(context["error"])
    else:
        rule = details["msg"].replace("Input should", "must", 1)
    return rule if " got " in rule or kind == "missing" else f"{rule}, got {shown(value)}{hint}"
