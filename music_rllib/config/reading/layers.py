"""Run settings laid over each other: variant preset < defaults < stage < its task < grid point.

Each value remembers where it was written, so that an error in the merged settings is reported at
the line that a person has to change.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any

from music_rllib.config.problems import Path, Problem, known_fields, lookup, shown, unknown
from music_rllib.config.run_settings import VARIANTS, RunSettings, Variant, contradiction, preset
from music_rllib.envs.tasks import Task

SECTIONS = ("evaluation", "tac", "music", "replay")
"""Groups of settings; layers replace their fields one by one."""
LAYER_KEYS = ("env_steps", "num_envs", *SECTIONS)
"""What `defaults`, a stage, its `per_task` and a grid point may set."""


def known_settings(path: Path) -> Iterable[str]:
    """Names of the settings below `path` of a run, for suggestions."""
    return known_fields(RunSettings, path) if path else LAYER_KEYS


def for_a_grid(rule: str, path: Path, settings: Any) -> str:
    """`rule`, with where to put several values if that is what `settings` have at `path`."""
    try:
        value = lookup(settings, path)
    except LookupError:
        return rule
    lists = rule.startswith(("must be a list", "must have", "must not"))
    if not isinstance(value, list) or len(path) > 2 or lists:
        return rule
    key = ".".join(map(str, path))
    return f"{rule}; values to compare belong in a stage's grid: {{{key}: {shown(value)}}}"


class Layers:
    """Settings merged so far, as plain data, with the origin of each value."""

    def __init__(self) -> None:
        self.data: dict[str, Any] = {}
        self._origins: dict[Path, Path] = {}

    def lay(self, settings: Mapping[str, Any], origin: Path) -> None:
        """Put `settings` on top; `origin` is their place in the sweep's document."""
        for key, value in settings.items():
            if key in SECTIONS and isinstance(value, Mapping):
                for field, inner in value.items():
                    self._put((key, field), inner, (*origin, key, field))
            elif value is not None or key not in SECTIONS:  # `tac:` with nothing below it
                self._put((key,), value, (*origin, key))

    def lay_point(self, dotted: str, value: Any, origin: Path) -> Problem | None:
        """Put one value of a grid on top; a problem if its key can't be."""
        path = tuple(dotted.split("."))
        if path[0] not in LAYER_KEYS:
            if path[0] in {"seed", "seeds", "task", "tasks"}:
                hint = f"; list them under '{path[0].removesuffix('s')}s'"
                return Problem(origin, f"{path[0]} is never a grid dimension{hint}")
            key = origin[:-1] if isinstance(origin[-1], int) else origin  # not for each value
            return Problem(key, unknown(dotted, all_settings()))
        try:
            above = lookup(self.data, path[:-1])
        except LookupError:
            above = {}
        if len(path) > 2 and not isinstance(above, Mapping):
            name = ".".join(path[:-1])
            return Problem(origin, f"needs {name} to be a mapping, got {shown(above)}")
        self._put(path, value, origin)
        return None

    def _put(self, path: Path, value: Any, origin: Path) -> None:
        here = self.data
        for part in path[:-1]:
            inner = here.get(str(part))
            here[str(part)] = dict(inner) if isinstance(inner, Mapping) else {}
            here = here[str(part)]
        here[str(path[-1])] = copy.deepcopy(value)
        self._origins[path] = origin

    def origin(self, path: Path, otherwise: Path) -> Path:
        """Where the value at `path` was written; `otherwise` for one that nobody wrote."""
        for length in range(len(path), 0, -1):
            if path[:length] in self._origins:
                return self._origins[path[:length]] + path[length:]
        return otherwise + path


def all_settings() -> list[str]:
    """Every setting of a run, those of sections with dots."""
    fields = [f"{section}.{name}" for section in SECTIONS for name in known_settings((section,))]
    return [*LAYER_KEYS, *fields]


def merge(
    variant: Variant,
    task: Task,
    defaults: Mapping[str, Any],
    stage: Mapping[str, Any],
    stage_path: Path,
    point: Mapping[str, tuple[Path, Any]],
) -> tuple[Layers, list[Problem]]:
    """Lay preset, defaults, stage, its `per_task` and one point of its grid over each other.

    Args:
        variant: The stage's variant.
        task: The task, whose preset weight applies where nothing else is said.
        defaults: The sweep's `defaults`.
        stage: The stage's own settings, keys of `LAYER_KEYS` and `per_task` only.
        stage_path: The stage's place in the document.
        point: Dotted key to (place of the value below the stage, value).

    Returns:
        The merged settings, and what is wrong with how they were laid.
    """
    layers = Layers()
    without_effect = VARIANTS[variant].without_effect
    layers.lay({"music": preset(variant, task)}, ())
    layers.lay(_with_effect(defaults, without_effect), ("defaults",))
    task_path = (*stage_path, "per_task", task.name)
    own = {stage_path: stage, task_path: (stage.get("per_task") or {}).get(task.name) or {}}
    idle = []
    for path, settings in own.items():
        layers.lay(_with_effect(settings, without_effect), path)
        idle += [(*path, *key.split(".")) for key in _idle(settings, without_effect)]
    problems = []
    for dotted, (below, value) in point.items():
        place = (*stage_path, *below)
        if dotted in without_effect:
            idle.append(place[: place.index(dotted) + 1])
        elif problem := layers.lay_point(dotted, value, place):
            problems.append(problem)
    problems += [Problem(place, f"has no effect with variant {variant}") for place in idle]
    return layers, problems + _contradictions(layers, variant, stage_path)


def _contradictions(layers: Layers, variant: Variant, stage_path: Path) -> list[Problem]:
    """Settings that contradict the variant, reported even where other settings are invalid."""
    music = layers.data["music"]
    return [
        Problem(
            layers.origin(("music", field), stage_path), contradiction(variant, fixed, music[field])
        )
        for field, fixed in VARIANTS[variant].fixed.items()
        if isinstance(music, Mapping) and music.get(field, fixed) != fixed
    ]


def _idle(settings: Mapping[str, Any], without_effect: frozenset[str]) -> list[str]:
    given = {
        f"{section}.{field}"
        for section in SECTIONS
        if isinstance(settings.get(section), Mapping)
        for field in settings[section]
    }
    return sorted(without_effect & given)


def _with_effect(settings: Mapping[str, Any], without_effect: frozenset[str]) -> dict[str, Any]:
    """`settings` less what means nothing to the variant, so that it doesn't change node keys."""
    kept = {key: value for key, value in settings.items() if key in LAYER_KEYS}
    for key in _idle(settings, without_effect):
        section, field = key.split(".")
        kept[section] = {name: value for name, value in kept[section].items() if name != field}
    return kept
