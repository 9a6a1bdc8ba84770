"""What is wrong with a configuration, in words for the person who wrote it.

Every problem names its place (file, line, dotted key), the rule and the value. Validation goes on
after the first one, so that a file is put right in one round.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from music_rllib.envs.tasks import closest
from music_rllib.errors import BadInputError
from music_rllib.labels import SYMBOLS

Model = TypeVar("Model", bound=BaseModel)

Path = tuple[str | int, ...]
"""Keys and list positions from the top of a document to one of its values."""


class Problem(NamedTuple):
    """One broken rule."""

    path: Path
    """Where, from the top of the document."""
    rule: str
    """What must hold, and what was found instead: `must be > 0, got -1`."""


class ConfigError(BadInputError, ValueError):
    """A configuration that can't be used; the message has one line per problem."""

    def __init__(self, lines: Sequence[str]) -> None:
        """Hold `lines`, each of which names place, rule and value."""
        super().__init__("\n".join(lines))
        self.lines = tuple(lines)


def shown(value: Any, limit: int = 60) -> str:
    """`value` as a user wrote it, more or less, and not too long."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except TypeError:
        text = repr(value)
    text = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(text, text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal as settings: 1 and 1.0 are, 1 and true are not."""
    if isinstance(one, bool) or isinstance(other, bool):
        return one is other
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def lookup(document: Any, path: Iterable[str | int]) -> Any:
    """The value at `path`.

    Raises:
        LookupError: There is none.
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
    """The rule that an unknown key breaks, with what was probably meant.

    Args:
        key: What was written, with dots or without.
        known: What could have been, with dots for what lies deeper.
    """
    names = list(known)
    field = key.rpartition(".")[2]
    field = SYMBOLS.get(field, field)
    meant = next((name for name in names if field in (name, name.rpartition(".")[2])), None)
    hint = closest(key, names) if meant is None else f" (did you mean {meant!r}?)"
    return f"is not a known setting{hint}"


def known_fields(model: type[BaseModel], path: Path) -> Iterable[str]:
    """Names of the fields below `path`, as far as models are nested plainly."""
    for part in path:
        field = model.model_fields.get(str(part))
        kind = field.annotation if field else None
        if not (isinstance(kind, type) and issubclass(kind, BaseModel)):
            return ()
        model = kind
    return model.model_fields


def in_words(
    error: ValidationError, document: Any, known: Callable[[Path], Iterable[str]]
) -> list[Problem]:
    """Translate pydantic's findings about `document`.

    Args:
        error: What pydantic raised.
        document: The input that it was raised for.
        known: Gives the keys that are known at a path, for suggestions.

    Returns:
        One problem per finding, paths relative to `document`.
    """
    problems = []
    for details in error.errors(include_url=False):
        if details["type"] == "too_short" and len(details["input"]) >= details["ctx"]["min_length"]:
            continue  # pydantic counts the sound entries only; the others are reported
        path = _without_tags(details["loc"], document, missing=details["type"] == "missing")
        rule = _rule(details, path, known)
        if details["type"] == "value_error":
            path, rule = _more_precise(path, rule, document)
        problems.append(Problem(path, rule))
    return problems


def _without_tags(loc: Path, document: Any, *, missing: bool) -> Path:
    """Drop the parts of `loc` that name members of a union and not keys of the document."""

    def readings(rest: Path, here: Any) -> Iterator[tuple[Path, list[str | int]]]:
        """Every way to read `rest`: the parts that are keys, and those that are dropped."""
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

    # A tag may be spelt like a key: right is what drops the fewest parts, and not the last one.
    path, _ = min(readings(loc, document), key=lambda r: (len(r[1]), loc[-1:] != r[0][-1:]))
    return path


def _more_precise(path: Path, rule: str, document: Any) -> tuple[Path, str]:
    """Rules about several fields begin with the one to change: put that into the path."""
    subject, _, rest = rule.partition(" ")
    keys = tuple(subject.split("."))
    here = lookup(document, path)
    if rest.startswith("must ") and isinstance(here, Mapping) and keys[0] in here:
        return path + keys, rest
    return path, rule


_FIXED_RULES = {
    "missing": "must be given",
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


def _rule(details: ErrorDetails, path: Path, known: Callable[[Path], Iterable[str]]) -> str:
    kind, context, value = details["type"], details.get("ctx", {}), details["input"]
    if kind == "extra_forbidden":
        return unknown(str(path[-1]), known(path[:-1]))
    if kind == "missing":
        return _FIXED_RULES[kind]
    if kind in _FIXED_RULES:
        rule = _FIXED_RULES[kind]
    elif kind in _COMPARISONS:
        sign, bound = _COMPARISONS[kind]
        rule = f"must be {sign} {context[bound]:g}"
    elif kind == "literal_error":
        rule = f"must be {context['expected']}"
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
    return f"{rule}, got {shown(value)}{_literal_hint(details)}"


def _literal_hint(details: ErrorDetails) -> str:
    if details["type"] != "literal_error" or not isinstance(details["input"], str):
        return ""
    expected = details["ctx"]["expected"].replace(" or ", ", ")
    return closest(details["input"], [word.strip("' ") for word in expected.split(",")])


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
        whole = _with_whole_numbers(value, error)
        if whole is None:
            raise
        return adapter.validate_json(json.dumps(whole), strict=True)


def _with_whole_numbers(value: Any, error: ValidationError) -> Any:
    """`value` with integers where it has `1e6` and an integer is asked for; None: it has none."""
    places = [
        _without_tags(details["loc"], value, missing=False)
        for details in error.errors(include_url=False)
        if details["type"] in {"int_type", "int_from_float"}
        and isinstance(details["input"], float)
        and details["input"].is_integer()
    ]
    for place in places:
        value = _replaced(value, place)
    return value if places else None


def _replaced(value: Any, path: Path) -> Any:
    """A copy of `value` with an integer in place of the number at `path`."""
    if not path:
        return int(value)
    copy: Any = dict(value) if isinstance(value, Mapping) else list(value)
    copy[path[0]] = _replaced(copy[path[0]], path[1:])
    return copy


class Findings:
    """Problems found so far, in a document that is checked to its end."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []

    def add(self, path: Path, rule: str) -> None:
        """Note a problem."""
        self.problems.append(Problem(path, rule))

    def validate(self, kind: type[Model], value: Any, path: Path) -> Model | None:
        """`value` as a `kind`; None, with the problems noted, if it isn't one."""
        try:
            return cast("Model", from_json(kind, value))
        except ValidationError as error:
            for found in in_words(error, value, lambda at: known_fields(kind, at)):
                self.add(path + found.path, found.rule)
            return None

    def forbid_repeats(self, values: Any, path: Path) -> None:
        """Note entries of the list `values` that are there twice; 1 and 1.0 are the same."""
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
