"""A sweep's settings as plain data, with the place where each value is written.

Three sources are laid over each other: a preset, the sweep's file, and the command line. A preset
is a YAML file of settings below `defaults`. On the command line, a setting (`tac.alpha=0.1`) holds
in every stage and replaces the file's values in `defaults`, in stages and for single tasks;
`stages.NAME.tac.alpha=0.1` changes one stage. A key of the file's top level (`seeds=5`,
`resources.cpus_per_run=2`) replaces the value there.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import music_rllib
from music_rllib.config.layers import all_settings, is_in, varied_by
from music_rllib.config.problems import ConfigError, KeyPath, Problem, lookup, shown, unknown
from music_rllib.config.run_settings import LAYER_KEYS, SECTIONS
from music_rllib.config.schema import RESERVED_NAMES, Header, StageHeader
from music_rllib.config.yaml_file import YamlFile, read_value, read_yaml
from music_rllib.envs.tasks import closest


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


# Presets and other files of the package ---------------------------------------------------------

FOLDER = "presets"
"""Folder beside the sweep's file; its presets replace the package's presets of the same name."""
SHIPPED = Path(music_rllib.__file__).with_name(FOLDER)
"""Folder of the package's presets."""
SCHEMA = Path(__file__).with_name("sweep.schema.json")
"""JSON Schema of a sweep's file, for editors; docs/generate_configuration.py writes it."""


def starter(file: Path) -> str:
    """The text of a commented sweep that is written as `file`."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", file.stem).strip("._-")[:80] or "sweep"
    if name in RESERVED_NAMES:
        name = f"{name}_sweep"
    # Quoted, since a name like 123 or true would not be text.
    known = {"name: NAME": f'name: "{name}"', "NAME": name, "FILE": shlex.quote(str(file))}
    text = Path(__file__).with_name("starter.yaml").read_text(encoding="utf-8")
    lines = re.sub("|".join(known), lambda found: known[found[0]], text)
    return f"# yaml-language-server: $schema={SCHEMA.as_uri()}\n{lines}"


def shipped_presets() -> dict[str, str]:
    """Map the names of the package's presets to the description in their first line."""
    descriptions = {}
    for path in sorted(SHIPPED.glob("*.yaml")):
        line = path.read_text(encoding="utf-8").partition("\n")[0]
        descriptions[path.stem] = line.removeprefix(f"# {path.stem}: ")
    return descriptions


def read_preset(name: Any, folder: Path, place: Place) -> YamlFile:
    """Read a preset by its name, or by its path from `folder` if `name` ends in `.yaml`.

    Raises:
        ConfigError: There is no such preset, or it can't be read.
    """
    if not isinstance(name, str) or not name:
        raise ConfigError([f"{place}: preset must be a preset's name or a file, got {shown(name)}"])
    if name.endswith((".yaml", ".yml")):
        return read_yaml(folder / name)
    known = {path.stem: path for one in (SHIPPED, folder / FOLDER) for path in one.glob("*.yaml")}
    if name not in known:
        choice = ", ".join(sorted(known))
        raise ConfigError(
            [f"{place}: preset must be one of {choice}, got {shown(name)}{closest(name, known)}"]
        )
    return read_yaml(known[name])


# The command line ---------------------------------------------------------------------------------


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Key to value, for `KEY=VALUE` arguments with values in YAML.

    A group, `tac={alpha: 0.1}`, gives one key for each field.

    Raises:
        ConfigError: One has no `=`, its key is unknown or repeated, or its value is not YAML.
    """
    overrides: dict[str, Any] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not all(key.split(".")):
            raise _refusal(f"must be KEY=VALUE like tac.alpha=0.1, got {shown(argument)}")
        if key.partition(".")[0] in LAYER_KEYS and key.count(".") > 1:
            setting = ".".join(key.split(".")[:2])
            raise _refusal(
                f"{key} must be a whole setting, {setting}={{...}}, got {shown(argument)}"
            )
        if key.partition(".")[0] not in (*LAYER_KEYS, *Header.model_fields):
            raise _refusal(f"{key} {unknown(key, (*all_settings(), *Header.model_fields))}")
        try:
            value = read_value(text)
        except ValueError as error:
            raise _refusal(f"{key} {error}, got {shown(text)}") from None
        fields = {key: value}
        if key in SECTIONS and isinstance(value, dict):
            fields = {f"{key}.{name}": inner for name, inner in value.items()}
        for one in fields.keys() & overrides.keys():
            raise _refusal(f"{one} must not repeat")
        overrides |= fields
    return overrides


def preset_path(value: Any) -> Any:
    """The value of `preset=...`, where a file is relative to the current folder."""
    if not isinstance(value, str) or not value.endswith((".yaml", ".yml")):
        return value
    try:
        return str(Path(value).expanduser().absolute())
    except RuntimeError:  # `~name/...`, and nobody has this name
        rule = "preset must be a file in an existing home folder"
        raise _refusal(f"{rule}, got {shown(value)}") from None


def lay_overrides(document: Document, overrides: Mapping[str, Any]) -> None:
    """Put `overrides` into the document.

    Raises:
        ConfigError: One names a stage that does not exist, or a setting that a grid or search
            varies.
    """
    left = dict(overrides)
    if "stages" in left:
        document.put(("stages",), left.pop("stages"))
    places: dict[str, KeyPath] = {
        key: _place_in_stage(document, key)
        if key.startswith("stages.")
        else _parts(key, "environments", _environments(document))
        for key in left
    }
    # A whole mapping comes before its parts, which it would replace.
    for key in sorted(left, key=lambda key: (_turn(places[key]), len(places[key]))):
        place, value = places[key], left[key]
        if place[0] in LAYER_KEYS:
            for stage in _stages(document):
                _check_not_varied(stage, key, value, key)
                _remove(place, stage, *_layers_of_tasks(stage))
            place = ("defaults", *place)
        elif place[0] == "stages":
            stage, setting = _stages(document)[int(place[1])], place[2:]
            layers = _layers_of_tasks(stage)
            if setting[0] == "per_task":
                setting, layers = setting[2:], []
            _check_whole(document, place, setting, key)
            if setting and setting[0] in LAYER_KEYS:
                is_group = setting[-1] in SECTIONS and isinstance(value, dict)
                for name, inner in value.items() if is_group else [("", value)]:
                    one = (*setting, name) if name else setting
                    for each in _stages(document):
                        dotted, of = ".".join(map(str, one)), str(stage.get("name"))
                        _check_not_varied(each, dotted, inner, key, of)
                    _remove(one, *layers)
        document.put(place, value)


def _turn(place: KeyPath) -> int:
    """The turn of an override, in any order of the arguments: those of one stage come last.

    A new grid or search of a stage comes first: it decides which settings may be given.
    """
    if place[0] != "stages":
        return 1
    return {"grid": 0, "search": 0, "per_task": 3}.get(str(place[2]), 2)


def _layers_of_tasks(stage: Mapping[str, Any]) -> list[Any]:
    tasks = find(stage, ("per_task",))
    return [*tasks.values()] if isinstance(tasks, dict) else []


def _check_whole(document: Document, place: KeyPath, setting: KeyPath, typed: str) -> None:
    """Refuse a value inside of a setting that is not written at its place, where it would be alone.

    The argument `typed` sets `place`, the dotted `setting` of a stage or of one of its tasks.
    """
    inside = len(setting) > 2 and setting[0] in LAYER_KEYS
    above = place[: len(place) - len(setting) + 2]
    if inside and not isinstance(find(document.data, above), dict):
        whole = typed.removesuffix("." + ".".join(map(str, setting[2:])))
        raise _refusal(f"{typed} must be a whole setting, {whole}={{...}}, got a part of it")


def _remove(place: KeyPath, *layers: Any) -> None:
    """Remove a setting that an override replaces."""
    for layer in layers:
        if isinstance(group := find(layer, place[:-1]), dict):
            group.pop(place[-1], None)


def _check_not_varied(
    stage: Mapping[str, Any], key: str, value: Any, typed: str, of: str | None = None
) -> None:
    """Refuse the setting `key` of the argument `typed` if the stage varies it.

    `of` is the stage that the argument names; None: all stages. A search may vary settings of the
    stage that its own starts from, as `STAGE:setting`.
    """
    for group in (("grid",), ("search", "space"), ("search", "compare")):
        varied = find(stage, group)
        for name, choices in varied.items() if isinstance(varied, dict) else ():
            if of is not None and (str(name).rpartition(":")[0] or stage.get("name")) != of:
                continue
            choices = choices.get("choice") if isinstance(choices, dict) else choices
            choices = choices if isinstance(choices, list) else []
            settings = varied_by(str(name).rpartition(":")[2], choices)
            if any(is_in(key, one) or is_in(one, key) for one in settings):
                place = f"stages.{stage.get('name')}.{'.'.join(group)}.{name}"
                rule = f"{typed} must not be given where {place} varies it"
                if group == ("grid",) and name == key:
                    # A list is several values, unless a value is a list, as of hidden_sizes.
                    lists = any(isinstance(one, list) for one in choices)
                    values = value if isinstance(value, list) and not lists else [value]
                    rule += f"; {place}='{shown(values)}' replaces its values"
                raise _refusal(rule)


def _place_in_stage(document: Document, key: str) -> KeyPath:
    """The place of `stages.NAME...`; a dotted key of a grid or space is one part of it."""
    names = [str(stage.get("name")) for stage in _stages(document)]
    _, name, *setting = _parts(key, "stages", names)
    if name not in names or not setting:
        raise _refusal(f"{key} must be stages.NAME.KEY, with NAME one of {', '.join(names)}")
    rest = ".".join(setting)
    parts = _parts(rest, "per_task", _environments(document))
    known = (*StageHeader.model_fields, *all_settings())
    if parts[0] not in known:
        raise _refusal(f"{key} {unknown(rest, known)}")
    for group in (("grid",), ("search", "space"), ("search", "compare")):
        if parts[: len(group)] == group and len(parts) > len(group):
            parts = (*group, ".".join(parts[len(group) :]))
    return ("stages", names.index(name), *parts)


def _parts(key: str, group: str, names: Iterable[str]) -> tuple[str, ...]:
    """The parts of a dotted key; below `group`, one of `names`, which may have dots, is one."""
    for name in sorted(names, key=len, reverse=True):
        if f"{key}.".startswith(f"{group}.{name}."):
            rest = key.removeprefix(f"{group}.{name}").removeprefix(".")
            return (group, name, *filter(None, rest.split(".")))
    return tuple(key.split("."))


def _environments(document: Document) -> list[str]:
    declared = find(document.data, ("environments",))
    return [*map(str, declared)] if isinstance(declared, dict) else []


def _stages(document: Document) -> list[dict[str, Any]]:
    stages = document.data.get("stages")
    stages = stages if isinstance(stages, list) else []
    return [stage if isinstance(stage, dict) else {} for stage in stages]


def _refusal(rule: str) -> ConfigError:
    return ConfigError([f"command line: {rule}"])
