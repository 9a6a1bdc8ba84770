"""Reads and validates a sweep's YAML file before anything starts.

:func:`load_config` reports all problems at once, each as ``file:line: key rule, got value``. The
sweep that it returns is resolved: each stage has the complete settings of a run for each point of
its grid and each task.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from music_rllib.config.checks import check_analysis
from music_rllib.config.document import (
    Document,
    Place,
    lay_overrides,
    parse_overrides,
    preset_path,
    read_preset,
)
from music_rllib.config.layers import all_settings
from music_rllib.config.problems import ConfigError, Findings, shown, unknown
from music_rllib.config.run_settings import LAYER_KEYS
from music_rllib.config.schema import Header, Stage, SweepConfig
from music_rllib.config.search import FINAL_SEED
from music_rllib.config.stages import resolve_stage
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task, closest, search_in
from music_rllib.limits import MOST_RUNS, MOST_SEEDS
from music_rllib.redaction import without_secrets
from music_rllib.store.storage import expanded


def load_config(
    path: str | Path,
    *,
    name: str | None = None,
    storage: str | None = None,
    seeds: str | None = None,
    overrides: Sequence[str] = (),
) -> SweepConfig:
    """Read and validate a sweep.

    Args:
        path: The YAML file.
        name: Replaces the file's `name`.
        storage: Replaces the file's `storage`.
        seeds: Replaces the file's `seeds`: a number (the file's seeds first, then the smallest
            others) or a list with commas.
        overrides: `KEY=VALUE` each, which replace the file's values.

    Raises:
        ConfigError: With one line per problem.
    """
    document, findings = Document(Path(path)), Findings()
    given = parse_overrides(overrides)
    if "preset" in given:
        document.put(("preset",), preset_path(given.pop("preset")))
    if "defaults" in given:  # replaces the file's, which lie above the preset
        document.put(("defaults",), given.pop("defaults"))
    place = document.place(("preset",))
    if (preset := document.data.pop("preset", None)) is not None:
        document.lay_over(read_preset(preset, Path(path).parent, place))
    lay_overrides(document, given)
    _list_seeds(document, findings)
    if isinstance(document.data.get("storage"), str):
        try:
            document.data["storage"] = expanded(document.data["storage"])
        except ValueError as error:
            if storage is None:
                findings.add(("storage",), str(error))
    if seeds is not None:
        document.put(("seeds",), _parsed_seeds(seeds, document.data["seeds"]), Place("--seeds"))
    for key, text in (("name", name), ("storage", storage)):
        if text is not None:
            document.put((key,), _checked_text(key, text), Place(f"--{key}"))
    config = _resolve(document, findings)
    if config is None:
        raise ConfigError(document.lines(findings.problems))
    return config


def _checked_text(key: str, text: str) -> str:
    try:
        text.encode()
    except UnicodeEncodeError:  # bytes of the command line that are not UTF-8
        raise ConfigError([f"--{key} must be UTF-8 text, got {text!a}"]) from None
    return text


def declared_tasks(path: str | Path) -> tuple[Task, ...]:
    """The tasks that a sweep's YAML file declares under `environments`.

    From then on, modules of environments are also searched beside the file.

    Raises:
        ConfigError: The file can't be read, or a task is invalid.
    """
    document, findings = Document(Path(path)), Findings()
    registry = _registry(document.data, findings)
    if findings.problems:
        raise ConfigError(document.lines(findings.problems))
    search_in(Path(path).parent)
    return tuple(task for name, task in registry.items() if name not in BUILT_IN_TASKS)


def _list_seeds(document: Document, findings: Findings) -> None:
    """Replace a number of seeds by their list: `5` means the seeds 0 to 4."""
    seeds = document.data.setdefault("seeds", [0])
    if isinstance(seeds, bool) or not isinstance(seeds, int | float):
        return
    valid = 1 <= seeds <= MOST_SEEDS and seeds == int(seeds)
    if not valid:
        rule = f"must be a list like [0, 1], or a number (1 to {MOST_SEEDS:,}), got {shown(seeds)}"
        findings.add(("seeds",), rule)
    document.data["seeds"] = list(range(int(seeds))) if valid else [0]


def _parsed_seeds(text: str, given: Any) -> list[float]:
    """The seeds of `10` or `0,1,7`; a number keeps the seeds `given` in the file."""
    digits = re.fullmatch(r"\d{1,10}(,\d{1,10})*,?", text)
    if digits and "," not in text and int(text) > MOST_SEEDS:
        raise ConfigError([f"--seeds must be at most {MOST_SEEDS:,} seeds, got {text}"])
    if not digits or text == "0":
        raise ConfigError(
            [f"--seeds must be a number of seeds or a list like 0,1,7, got {shown(text)}"]
        )
    if "," in text:
        return [int(seed) for seed in text.split(",") if seed]
    given = given if isinstance(given, list) else [0]
    known = [seed for seed in given if isinstance(seed, int | float)]  # 1e3 is a whole number
    others = (seed for seed in itertools.count() if seed not in known)
    return [*known, *itertools.islice(others, max(int(text) - len(known), 0))][: int(text)]


_OF_RUNS = ("env_kwargs", "settings", "space", "compare", "grid")
"""Mappings whose keys the user chooses and that decide what is trained."""


def _check_recorded(value: Any, findings: Findings) -> None:
    """Add a problem for each setting of runs that the record of a sweep would hide as a secret.

    `resume`, which reads the record, would train something else.
    """
    pairs = value.items() if isinstance(value, dict) else enumerate(_list(value))
    for key, inner in pairs:
        if key not in _OF_RUNS or not isinstance(inner, dict):
            _check_recorded(inner, findings.below(key))
            continue
        kept = without_secrets(inner)
        for name in inner:
            if str(name) not in kept or repr(kept[str(name)]) != repr(inner[name]):
                rule = "must have another name or value: this one looks like a secret, which is"
                findings.add((key, name), f"{rule} not recorded for `resume`")


def _resolve(document: Document, findings: Findings) -> SweepConfig | None:
    """The sweep; None if there are problems, which are added to `findings`."""
    data = document.data
    _check_recorded(data, findings)
    registry = _registry(data, findings)
    header = _header(data, findings)
    defaults = _mapping(data.get("defaults"))
    for key in defaults.keys() - set(LAYER_KEYS):
        findings.add(("defaults", key), unknown(key, all_settings()))

    def find_tasks(names: Iterable[str], findings: Findings) -> tuple[Task, ...]:
        for position, name in enumerate(names):
            # An invalid declaration is a problem already, and its name is known.
            if name not in {**registry, **_mapping(data.get("environments"))}:
                known = ", ".join(registry)
                rule = f"must be a known task ({known}), got {name!r}{closest(name, registry)}"
                findings.add((position,), rule)
        return tuple(registry[name] for name in names if name in registry)

    names = [name for name in _list(data.get("tasks")) if isinstance(name, str)]
    sweep_tasks = find_tasks(names, findings.below("tasks"))
    stages: dict[str, Stage | None] = {}
    for index, raw in enumerate(_list(data.get("stages"))):
        if not isinstance(raw, dict):
            continue
        stage = resolve_stage(
            raw,
            findings.below("stages", index),
            defaults=defaults,
            seeds=header.seeds if header else (),
            sweep_tasks=sweep_tasks,
            find_tasks=find_tasks,
            earlier=stages,
        )
        stages[stage.name if stage else str(raw.get("name"))] = stage
    if header is None:
        return None
    _count_runs(stages, len(header.seeds), findings)
    if any(stage and stage.search for stage in stages.values()):
        for position, seed in enumerate(header.seeds):
            if seed >= FINAL_SEED:
                rule = f"must be < {FINAL_SEED}, where a search's fresh seeds begin, got {seed}"
                findings.add(("seeds", position), rule)
    if header.analysis:
        check_analysis(header.analysis, stages, findings)
    if findings.problems:
        return None
    return SweepConfig(
        path=document.file.path,
        document=data,
        name=header.name,
        seeds=header.seeds,
        storage=header.storage,
        mlflow=header.mlflow,
        resources=header.resources,
        checkpoints=header.checkpoints,
        analysis=header.analysis,
        stages=tuple(stage for stage in stages.values() if stage is not None),
    )


def _mapping(value: Any) -> dict[str, Any]:
    """`value` if it is a mapping; the problem of another value is reported with the header."""
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _header(data: dict[str, Any], findings: Findings) -> Header | None:
    known = (*Header.model_fields, *sorted(f"defaults.{name}" for name in all_settings()))
    for key in data.keys() - Header.model_fields:
        findings.add((key,), unknown(key, known))
    values = {key: value for key, value in data.items() if key in Header.model_fields}
    for key in ("tasks", "seeds"):
        findings.forbid_repeats(values.get(key), (key,))
    return findings.validate(Header, values)


def _registry(data: dict[str, Any], findings: Findings) -> dict[str, Task]:
    """The built-in tasks and those of the sweep, by name."""
    tasks = dict(BUILT_IN_TASKS)
    for name, raw in _mapping(data.get("environments")).items():
        path = ("environments", name)
        if name in BUILT_IN_TASKS:
            findings.add(path, "is a built-in task; choose another name")
        elif "name" in _mapping(raw):
            findings.add((*path, "name"), f"must not be given, got {shown(raw['name'])}")
        elif isinstance(raw, dict) and (
            task := findings.below(*path).validate(Task, raw | {"name": name})
        ):
            tasks[name] = task
    return tasks


def _count_runs(stages: Mapping[str, Stage | None], seeds: int, findings: Findings) -> None:
    """Reject more runs than can be planned; they multiply from stage to stage."""
    trials: dict[str, int] = {}
    total = 0
    for index, (name, stage) in enumerate(stages.items()):
        if stage is None or stage.search is not None:
            continue
        trials[name] = len(stage.points) * trials.get(str(stage.source_stage), 1)
        total += trials[name] * len(stage.tasks) * seeds
        if total > MOST_RUNS:
            rule = f"must not make the sweep larger than {MOST_RUNS:,} runs, got {total:,}"
            findings.add(("stages", index), rule)
            return


def warnings_of(config: SweepConfig) -> list[str]:
    """One line for each property of a valid sweep that may be unintended."""
    return [
        f"{stage.name}: search.trials is {search.trials:,}, and the space has {search.count:,} "
        f"points: the search ends after {search.count:,} trials"
        for stage in config.stages
        if (search := stage.search) is not None and (search.trials or 0) > search.count
    ]
