"""Reads and validates a sweep's YAML file before anything starts.

:func:`load_sweep` reports all problems at once, each as ``file:line: key rule, got value``. The
sweep that it returns is resolved: each stage has the complete settings of a run for each point of
its grid and each task.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from music_rllib.config.hypotheses import check_analysis
from music_rllib.config.layers import (
    LAYER_KEYS,
    SECTIONS,
    all_settings,
    for_a_grid,
    known_settings,
)
from music_rllib.config.overrides import lay_overrides, parse_overrides
from music_rllib.config.presets import with_preset
from music_rllib.config.problems import (
    ConfigError,
    Findings,
    Problem,
    from_json,
    problem_lines,
    problems_of,
    shown,
    unknown,
)
from music_rllib.config.resolve import resolve_stage
from music_rllib.config.run_settings import RunSettings, without_retired
from music_rllib.config.schema import (
    RESERVED_NAMES,
    Header,
    Stage,
    SweepConfig,
)
from music_rllib.config.search import FINAL_SEED
from music_rllib.config.yaml_file import YamlFile, read_yaml
from music_rllib.envs.modules import search_in
from music_rllib.envs.tasks import (
    BUILT_IN_TASKS,
    Task,
    TaskRegistry,
    UnknownTaskError,
)
from music_rllib.limits import MOST_RUNS, MOST_SEEDS
from music_rllib.store.storage import expanded


def load_sweep(
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
    texts = {"name": name, "storage": storage}
    options: dict[str, Any] = {key: text for key, text in texts.items() if text is not None}
    for key, text in options.items():
        try:
            text.encode()
        except UnicodeEncodeError:  # bytes of the command line that are not UTF-8
            raise ConfigError([f"--{key} must be UTF-8 text, got {text!a}"]) from None
    file = read_yaml(Path(path))
    given = parse_overrides(overrides)
    if (preset := given.pop("preset", None)) is not None:
        file = file._replace(data=file.data | {"preset": preset.value})
    document, origins = lay_overrides(with_preset(file, _preset_problems), given.values())
    if preset is not None:
        origins["preset",] = preset.key
    if "seeds" in document:
        document["seeds"] = _listed_seeds(document["seeds"])
    if seeds is not None:
        options["seeds"] = _parsed_seeds(seeds, document.get("seeds"))
    document |= options
    findings = Findings()
    if storage is None and isinstance(document.get("storage"), str):  # a shell expands --storage
        try:
            document["storage"] = expanded(document["storage"])
        except ValueError as error:
            findings.add(("storage",), str(error))
    config = _resolve(file, document, findings)
    if config is None:
        raise ConfigError(problem_lines(findings.problems, file, document, options, origins))
    return replace(config, arguments=tuple(overrides))


def _listed_seeds(seeds: Any) -> Any:
    """The list of seeds for a valid number of them: `5` means the seeds 0 to 4."""
    if isinstance(seeds, bool) or not isinstance(seeds, int | float):
        return seeds
    return list(range(int(seeds))) if 1 <= seeds <= MOST_SEEDS and seeds == int(seeds) else seeds


def declared_tasks(path: str | Path) -> tuple[Task, ...]:
    """The tasks that a sweep's YAML file declares under `environments`.

    From then on the modules of environments are looked for beside the file, too.

    Raises:
        ConfigError: The file can't be read, or a task is invalid.
    """
    file, findings = read_yaml(Path(path)), Findings()
    registry = _registry(file.data, findings)
    if findings.problems:
        raise ConfigError(problem_lines(findings.problems, file, file.data, {}))
    search_in(Path(path).parent)
    return tuple(task for name, task in registry.items() if name not in BUILT_IN_TASKS)


def _parsed_seeds(text: str, given: Any) -> list[float]:
    """The seeds of `10` or `0,1,7`; a number keeps those `given` in the file."""
    digits = re.fullmatch(r"\d{1,9}(,\d{1,9})*,?", text)
    if digits and "," not in text and int(text) > MOST_SEEDS:
        raise ConfigError([f"--seeds must be at most {MOST_SEEDS:,} seeds, got {text}"])
    if not digits or text in {"0", ""}:
        raise ConfigError(
            [f"--seeds must be a number of seeds or a list like 0,1,7, got {shown(text)}"]
        )
    if "," in text:
        return [int(seed) for seed in text.split(",") if seed]
    given = given if isinstance(given, list) else [0]
    known = [seed for seed in given if isinstance(seed, int | float)]  # 1e3 is a whole number
    others = (seed for seed in itertools.count() if seed not in known)
    return [*known, *itertools.islice(others, max(int(text) - len(known), 0))][: int(text)]


def _preset_problems(preset: YamlFile) -> list[str]:
    """The problems of a preset's own settings, as lines."""
    findings = Findings()
    _defaults({"defaults": preset.data}, findings)
    problems = [Problem(problem.path[1:], problem.rule) for problem in findings.problems]
    return problem_lines(problems, preset, preset.data, {})


def _resolve(file: YamlFile, document: dict[str, Any], findings: Findings) -> SweepConfig | None:
    """The sweep; None if there are problems, which are added to `findings`."""
    registry = _registry(document, findings)
    header = _header(document, findings)
    defaults = _defaults(document, findings)
    names, declared = document.get("tasks"), document.get("environments")
    names = [name for name in names if isinstance(name, str)] if isinstance(names, list) else []

    def find_tasks(names: Iterable[str], findings: Findings) -> tuple[Task, ...]:
        tasks = []
        for position, name in enumerate(names):
            try:
                tasks.append(registry[name])
            except UnknownTaskError as error:
                # An invalid declaration is a problem already, and its name is not unknown.
                if not isinstance(declared, dict) or name not in declared:
                    findings.add((position,), str(error))
        return tuple(tasks)

    sweep_tasks = find_tasks(names, findings.below("tasks"))
    raw_stages = document.get("stages")
    if not isinstance(raw_stages, list) or not raw_stages:
        rule = f"must be a list of at least one stage, got {shown(raw_stages)}"
        findings.add(("stages",), rule)
        raw_stages = []
    stages: dict[str, Stage | None] = {}
    for index, raw in enumerate(raw_stages):
        if not isinstance(raw, dict):
            findings.add(("stages", index), f"must be a mapping, got {shown(raw)}")
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
    if header:
        _count_runs(stages, len(header.seeds), findings)
    if header and any(stage and stage.search for stage in stages.values()):
        for position, seed in enumerate(header.seeds):
            if seed >= FINAL_SEED:
                rule = f"must be < {FINAL_SEED}, where a search's fresh seeds begin, got {seed}"
                findings.add(("seeds", position), rule)
    if header and header.analysis:
        check_analysis(header.analysis, stages, findings)
    if findings.problems or header is None:
        return None
    return SweepConfig(
        path=file.path,
        text=file.text,
        document=document,
        name=header.name,
        seeds=header.seeds,
        storage=header.storage,
        mlflow=header.mlflow,
        resources=header.resources,
        checkpoints=header.checkpoints,
        analysis=header.analysis,
        stages=tuple(stage for stage in stages.values() if stage is not None),
    )


def _count_runs(stages: Mapping[str, Stage | None], seeds: int, findings: Findings) -> None:
    """Refuse more runs than can be planned; they multiply from stage to stage."""
    trials: dict[str, int] = {}
    total = 0
    for index, (name, stage) in enumerate(stages.items()):
        if stage is None or stage.search is not None:
            continue
        above = stage.source.stage if stage.source else None
        trials[name] = len(stage.points) * trials.get(str(above), 1)
        total += trials[name] * len(stage.tasks) * seeds
        if total > MOST_RUNS:
            rule = f"must not make the sweep larger than {MOST_RUNS:,} runs, got {total:,}"
            findings.add(("stages", index), rule)
            return


def _registry(document: dict[str, Any], findings: Findings) -> TaskRegistry:
    tasks = []
    environments = document.get("environments") or {}
    if not isinstance(environments, dict):
        findings.add(("environments",), f"must be a mapping, got {shown(environments)}")
        environments = {}
    for name, raw in environments.items():
        path = ("environments", name)
        if name in BUILT_IN_TASKS:
            findings.add(path, "is a built-in task; choose another name")
        elif not isinstance(raw, dict) or "name" in raw:
            findings.add(path, f"must be a mapping without a name of its own, got {shown(raw)}")
        elif task := findings.below(*path).validate(Task, raw | {"name": name}):
            tasks.append(task)
    return TaskRegistry(tasks)


def _header(document: dict[str, Any], findings: Findings) -> Header | None:
    known = {*Header.model_fields, "preset", "environments", "defaults", "stages"}
    below = {f"defaults.{name}" for name in all_settings()}
    for key in document.keys() - known:
        findings.add((key,), unknown(key, (*known, *sorted(below))))
    values = {key: value for key, value in document.items() if key in Header.model_fields}
    if isinstance(values.get("seeds"), int | float):  # an invalid number: others are lists now
        rule = f"must be a list like [0, 1], or how many (1 to {MOST_SEEDS:,})"
        findings.add(("seeds",), f"{rule}, got {shown(values.pop('seeds'))}")
    header = findings.validate(Header, values)
    if header and header.name in RESERVED_NAMES:
        findings.add(("name",), f"must not be {header.name!r}, which the storage uses itself")
    for key in ("tasks", "seeds"):
        findings.forbid_repeats(values.get(key), (key,))
    if header and len(header.seeds) > MOST_SEEDS:
        rule = f"must have at most {MOST_SEEDS:,} entries, got {len(header.seeds):,}"
        findings.add(("seeds",), rule)
    return header


def _defaults(document: dict[str, Any], findings: Findings) -> dict[str, Any]:
    """`defaults`, checked as far as they can be before they are merged with a stage."""
    defaults = document.get("defaults") or {}
    if not isinstance(defaults, dict):
        findings.add(("defaults",), f"must be a mapping, got {shown(defaults)}")
        return {}
    for key, value in defaults.items():
        if key not in LAYER_KEYS:
            findings.add(("defaults", key), unknown(key, all_settings()))
        elif not (key in SECTIONS and value is None):
            _check_fields(key, value, findings)
    return defaults


def _check_fields(key: str, value: Any, findings: Findings) -> None:
    """Validate a group's fields alone: rules between groups depend on the variant."""
    field, value = RunSettings.model_fields[key], without_retired({key: value})[key]
    try:
        from_json(field.rebuild_annotation(), value)
    except ValidationError as error:
        for path, rule in problems_of(error, value, lambda at: known_settings((key, *at))):
            if path or not isinstance(value, dict):
                rule = for_a_grid(rule, (key, *path), {key: value})
                findings.add(("defaults", key, *path), rule)
