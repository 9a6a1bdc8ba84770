"""One stage of a sweep: its settings merged and validated, its source found and checked."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from music_rllib.config.problems import (
    ConfigError,
    Findings,
    from_json,
    in_words,
    shown,
    unknown,
)
from music_rllib.config.problems import Path as KeyPath
from music_rllib.config.reading.layers import (
    LAYER_KEYS,
    all_settings,
    for_a_grid,
    known_settings,
    merge,
)
from music_rllib.config.run_settings import VARIANTS, RunSettings, Variant, handed_over
from music_rllib.config.schema import (
    Checkpoint,
    InitFrom,
    Point,
    Source,
    Stage,
    StageHeader,
)
from music_rllib.config.search.check import check_search
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task, closest
from music_rllib.limits import MOST_GRID_POINTS
from music_rllib.store.handoff import Architecture, HandoffError, open_handoff, read_handoff

FindTasks = Callable[[Iterable[str], KeyPath], tuple[Task, ...]]


def resolve_stage(
    raw: dict[str, Any],
    path: KeyPath,
    *,
    defaults: Mapping[str, Any],
    seeds: tuple[int, ...],
    sweep_tasks: tuple[Task, ...],
    find_tasks: FindTasks,
    earlier: Mapping[str, Stage | None],
    findings: Findings,
) -> Stage | None:
    """Resolve one entry of `stages`.

    Args:
        raw: The entry.
        path: Its place in the document.
        defaults: The sweep's `defaults`.
        seeds: The sweep's, if they are known; the first goes into the settings, the plan puts
            in the others.
        sweep_tasks: The tasks of a stage that names none.
        find_tasks: Looks tasks up by name, noting those it doesn't find.
        earlier: The stages above this one by name; None for one that can't be made out.
        findings: Takes the problems.

    Returns:
        The stage; None if it can't be made out at all. With problems noted, what is returned
        only serves to check the stages below.
    """
    problems_before = len(findings.problems)
    header = _header(raw, path, findings)
    if header is None:
        return None
    if header.name in earlier:
        findings.add((*path, "name"), f"must not repeat, got {header.name!r} again")
    tasks = sweep_tasks
    if header.tasks is not None:
        findings.forbid_repeats(header.tasks, (*path, "tasks"))
        tasks = find_tasks(header.tasks, (*path, "tasks"))
    tasks = _with_split(tasks, header, path, findings)
    seed = seeds[0] if seeds else 0
    settings = {key: raw[key] for key in LAYER_KEYS if key in raw}
    settings["per_task"] = _per_task(header, tasks, path, findings)

    def resolve_at(point: Mapping[str, tuple[KeyPath, Any]], found: Findings) -> Point:
        return _resolve_point(header.variant, point, tasks, defaults, settings, seed, path, found)

    size = math.prod(map(len, header.grid.values()))
    if size > MOST_GRID_POINTS:  # counted before any of them is made
        rule = f"must have at most {MOST_GRID_POINTS:,} points, got {size:,}"
        findings.add((*path, "grid"), rule)
        return None
    points = tuple(resolve_at(point, findings) for point in _grid_points(header.grid))
    if len(findings.problems) == problems_before:
        _forbid_equal_points(points, path, findings)
    source = _source(header, path, find_tasks, findings)
    if header.search is not None:
        check_search(header, source, earlier, points, len(seeds), resolve_at, path, findings)
    stage = Stage(
        name=header.name,
        variant=header.variant,
        tasks=tasks,
        source=source,
        points=points,
        search=header.search,
        resolve=_resolver(resolve_at),
    )
    if source is not None:
        _check_source(stage, source, earlier, (*path, "init_from"), findings)
    return stage


def _resolver(
    resolve_at: Callable[[Mapping[str, tuple[KeyPath, Any]], Findings], Point],
) -> Callable[[Mapping[str, Any]], Point]:
    """`Stage.resolve`: the values' place is their own name."""

    def resolve(values: Mapping[str, Any]) -> Point:
        found = Findings()
        point = resolve_at({name: ((name,), value) for name, value in values.items()}, found)
        if found.problems:
            lines = [f"{problem.path[-1]} {problem.rule}" for problem in found.problems]
            raise ConfigError(list(dict.fromkeys(lines)))
        return point

    return resolve


def _header(raw: dict[str, Any], path: KeyPath, findings: Findings) -> StageHeader | None:
    known = {*StageHeader.model_fields, *LAYER_KEYS}
    for key in raw.keys() - known:
        findings.add((*path, key), unknown(key, (*known, *all_settings())))
    values = {key: value for key, value in raw.items() if key in StageHeader.model_fields}
    if isinstance(values.get("init_from"), str):
        values["init_from"] = {"stage": values["init_from"]}
    header = findings.validate(StageHeader, values, path)
    grid = values.get("grid")
    for dotted, choices in grid.items() if isinstance(grid, dict) else ():
        findings.forbid_repeats(choices, (*path, "grid", dotted))
    return header


def _with_split(
    tasks: tuple[Task, ...], header: StageHeader, path: KeyPath, findings: Findings
) -> tuple[Task, ...]:
    """The tasks that the variant can be used on; the others are problems."""
    if not VARIANTS[header.variant].uses_mi:
        return tasks
    place = (*path, "tasks") if header.tasks is not None else ("tasks",)
    for task in tasks:
        if not task.has_split:
            findings.add(
                place,
                "must have agent_indices and surrounding_indices to be used with MUSIC, "
                f"got {task.name}, which has none",
            )
    return tuple(task for task in tasks if task.has_split)


def _per_task(
    header: StageHeader, tasks: tuple[Task, ...], path: KeyPath, findings: Findings
) -> dict[str, dict[str, Any]]:
    """What the stage sets for single tasks; each must be one of its own."""
    known = [task.name for task in tasks]
    for name, settings in header.per_task.items():
        place = (*path, "per_task", name)
        if name not in known:
            findings.add(place, f"is not a task of this stage ({', '.join(known)})")
        for key in settings.keys() - set(LAYER_KEYS):
            findings.add((*place, key), unknown(key, all_settings()))
    return header.per_task


def _grid_points(grid: Mapping[str, list[Any]]) -> list[dict[str, tuple[KeyPath, Any]]]:
    """Cartesian product, the last key varying fastest; places are kept for messages."""
    axes = [
        [(("grid", key, position), value) for position, value in enumerate(grid[key])]
        for key in grid
    ]
    return [dict(zip(grid, combination, strict=True)) for combination in itertools.product(*axes)]


def _resolve_point(
    variant: Variant,
    point: Mapping[str, tuple[KeyPath, Any]],
    tasks: tuple[Task, ...],
    defaults: Mapping[str, Any],
    settings: Mapping[str, Any],
    seed: int,
    path: KeyPath,
    findings: Findings,
) -> Point:
    runs = {}
    # Settings are checked even where no task is right.
    for task in tasks or (BUILT_IN_TASKS["FetchPush"],):
        layers, problems = merge(variant, task, defaults, settings, path, point)
        findings.problems += problems
        data = layers.data | {"task": task.model_dump(), "variant": variant, "seed": seed}
        try:
            runs[task.name] = from_json(RunSettings, data)
        except ValidationError as error:
            for found in in_words(error, data, known_settings):
                # Settings that contradict their variant can't be consistent among themselves.
                if not (problems and found.path == ("music",)):
                    rule = for_a_grid(found.rule, found.path, data)
                    findings.add(layers.origin(found.path, path), rule)
    return Point(values={key: value for key, (_, value) in point.items()}, runs=runs)


def _forbid_equal_points(points: tuple[Point, ...], path: KeyPath, findings: Findings) -> None:
    """Two spellings of one schedule, say: the same trial twice."""
    seen = set()
    for point in points:
        runs = tuple(run.model_dump_json() for run in point.runs.values())
        if runs and runs in seen:
            findings.add(
                (*path, "grid"),
                f"must not have two equal points, got {shown(point.values)} again",
            )
        seen.add(runs)


def _source(
    header: StageHeader, path: KeyPath, find_tasks: FindTasks, findings: Findings
) -> Source | None:
    place = (*path, "init_from")
    starts_from = VARIANTS[header.variant].starts_from
    if header.init_from is None:
        if starts_from != "scratch":
            rule = f"must be given for {header.variant}, which starts from a trained {starts_from}"
            findings.add(place, rule)
        return None
    if starts_from == "scratch":
        findings.add(place, f"has no effect with variant {header.variant}: it starts from scratch")
        return None
    task = None
    if header.init_from.task is not None:
        found = find_tasks([header.init_from.task], place)
        if not found:
            return None
        task = found[0]
    if header.init_from.stage is not None:
        return Source(stage=header.init_from.stage, task=task)
    return _checkpoint(header.init_from, task, place, findings)


def _checkpoint(
    init_from: InitFrom, task: Task | None, place: KeyPath, findings: Findings
) -> Source | None:
    folder = Path(str(init_from.checkpoint)).expanduser().absolute()
    try:
        folder, manifest = open_handoff(folder)
    except HandoffError as error:
        findings.add((*place, "checkpoint"), str(error))
        return None
    return Source(checkpoint=Checkpoint(folder=folder, manifest=manifest), task=task)


def _check_source(
    stage: Stage,
    source: Source,
    earlier: Mapping[str, Stage | None],
    place: KeyPath,
    findings: Findings,
) -> None:
    if source.checkpoint is not None:
        _check_checkpoint(stage, source, source.checkpoint, (*place, "checkpoint"), findings)
    elif source.stage not in earlier:
        known = f" (one of {', '.join(earlier)})" if earlier else ""
        hint = closest(str(source.stage), earlier)
        findings.add(place, f"must be an earlier stage{known}, got {source.stage!r}{hint}")
    elif (above := earlier[str(source.stage)]) is not None and above.search is not None:
        findings.add(
            place,
            f"must be a stage whose runs are known beforehand, got {above.name!r}, which is "
            "searched; start from its best trial's handoff with {checkpoint: FOLDER}",
        )
    elif above is not None:
        _check_stage(stage, source, above, place, findings)


def _check_checkpoint(
    stage: Stage, source: Source, checkpoint: Checkpoint, place: KeyPath, findings: Findings
) -> None:
    made_for = checkpoint.manifest.info.task
    wrong = [
        wanted.name
        for wanted in ([source.task] if source.task else stage.tasks)
        if wanted.identity() != made_for.identity()
    ]
    for name in wrong:
        findings.add(
            place,
            f"must be of task {name}, got one of {made_for.name}; "
            f"if that is meant, say 'task: {made_for.name}' beside it",
        )
    problems_before = len(findings.problems)
    theirs = (made_for, checkpoint.manifest.info.architecture)
    _check_fit(stage, [theirs], str(checkpoint.folder), place, findings)
    if len(findings.problems) > problems_before:
        return
    for needed in {handed_over(run) for point in stage.points for run in point.runs.values()}:
        try:
            read_handoff(checkpoint.folder, needed, made_for)
        except HandoffError as error:
            findings.add(place, str(error))


def _check_stage(
    stage: Stage, source: Source, above: Stage, place: KeyPath, findings: Findings
) -> None:
    estimator = VARIANTS[stage.variant].starts_from == "estimator"
    if estimator and not VARIANTS[above.variant].uses_mi:
        findings.add(
            place,
            f"must be a stage with an estimator, got {above.name!r}, which is {above.variant}",
        )
        return
    theirs_by_name = {task.name for task in above.tasks}
    for task in stage.tasks:
        wanted = source.task or task
        if wanted.name not in theirs_by_name:
            findings.add(
                place,
                f"needs a run of {wanted.name} in stage {above.name}, whose tasks are "
                f"{', '.join(sorted(theirs_by_name))}; name one: "
                f"{{stage: {above.name}, task: ...}}",
            )
    theirs = [(run.task, run.architecture) for point in above.points for run in point.runs.values()]
    _check_fit(stage, theirs, f"stage {above.name}", place, findings)


def _check_fit(
    stage: Stage,
    sources: Iterable[tuple[Task, Architecture]],
    origin: str,
    place: KeyPath,
    findings: Findings,
) -> None:
    """Settings that shape the handed-over arrays must be equal on both sides."""
    starts_from = VARIANTS[stage.variant].starts_from
    runs = [run for point in stage.points for run in point.runs.values()]
    for (task, theirs), run in itertools.product(sources, runs):
        for name in theirs.differences(run.architecture, starts_from):
            findings.add(place, f"needs the same {name} in stage {stage.name} as in {origin}")
        if starts_from == "estimator" and _split_sizes(task) != _split_sizes(run.task):
            findings.add(
                place,
                f"needs as many agent and surrounding indices in {run.task.name} as in "
                f"{task.name} ({origin}): {_split_sizes(run.task)} and {_split_sizes(task)}",
            )


def _split_sizes(task: Task) -> tuple[int, int]:
    return len(task.agent_indices), len(task.surrounding_indices)
