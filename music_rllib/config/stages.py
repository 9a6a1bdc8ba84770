"""One stage of a sweep: its settings merged and validated, its source found and checked."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from music_rllib.config.checks import check_search
from music_rllib.config.layers import PlacedPoint, all_settings, field_by_field, for_a_grid, merge
from music_rllib.config.problems import (
    ConfigError,
    Findings,
    KeyPath,
    Problem,
    from_json,
    problems_of,
    shown,
    unknown,
)
from music_rllib.config.run_settings import LAYER_KEYS, VARIANTS, RunSettings, Variant, handed_over
from music_rllib.config.schema import ImportedHandoff, Point, Source, Stage, StageHeader
from music_rllib.config.search import of_stage
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task, closest
from music_rllib.limits import MOST_GRID_POINTS
from music_rllib.store.handoff import (
    Architecture,
    HandoffError,
    open_handoff,
    read_handoff,
    task_differences,
)

FindTasks = Callable[[Iterable[str], Findings], tuple[Task, ...]]


def resolve_stage(
    raw: dict[str, Any],
    findings: Findings,
    *,
    defaults: Mapping[str, Any],
    seeds: tuple[int, ...],
    sweep_tasks: tuple[Task, ...],
    find_tasks: FindTasks,
    earlier: Mapping[str, Stage | None],
) -> Stage | None:
    """Resolve one entry of `stages`.

    Args:
        raw: The entry.
        findings: Takes the problems; its path is the entry's.
        defaults: The sweep's `defaults`.
        seeds: The sweep's seeds; empty if they are invalid. The settings have the first one, the
            plan puts in the others.
        sweep_tasks: The tasks of a stage that names none.
        find_tasks: Finds tasks by name; those that it does not find are problems.
        earlier: The stages above this one by name; None for an invalid one.

    Returns:
        The stage; None if it is too invalid for one. If there are problems, the stage only serves
        to check the stages below it.
    """
    problems_before = len(findings.problems)
    header = _header(raw, findings)
    if header is None:
        _check_defaults(defaults, findings)
        return None
    if header.name in earlier:
        findings.add(("name",), f"must not repeat, got {header.name!r} again")
    tasks = sweep_tasks
    if header.tasks is not None:
        findings.forbid_repeats(header.tasks, ("tasks",))
        tasks = find_tasks(header.tasks, findings.below("tasks"))
    _check_per_task(header, tasks, findings)
    settings = _StageSettings(
        variant=header.variant,
        tasks=tasks,
        defaults=defaults,
        own={key: raw[key] for key in LAYER_KEYS if key in raw} | {"per_task": header.per_task},
        seed=seeds[0] if seeds else 0,
        path=findings.path,
    )
    size = math.prod(map(len, header.grid.values()))
    if size > MOST_GRID_POINTS:  # counted before any of them is made
        rule = f"must have at most {MOST_GRID_POINTS:,} points, got {size:,}"
        findings.add(("grid",), rule)
        return None
    points = tuple(settings.at(point, findings) for point in _grid_points(header.grid))
    if len(findings.problems) == problems_before:
        _forbid_equal_points(points, findings)
    stage = Stage(
        name=header.name,
        variant=header.variant,
        tasks=tasks,
        source=_source(header, find_tasks, findings.below("init_from")),
        points=points,
        search=header.search,
        resolve=settings.resolve,
    )
    if stage.search is not None:
        if header.grid:
            findings.add(("grid",), "must not be given beside search: put it into the space")
        check_search(stage, stage.search, earlier, len(seeds), settings.at, findings)
    if stage.source is not None:
        _check_source(stage, stage.source, earlier, findings.below("init_from"))
    return stage


@dataclass(frozen=True, kw_only=True)
class _StageSettings:
    """The settings of a stage's runs, on which a point of its grid or search is laid."""

    variant: Variant
    tasks: tuple[Task, ...]
    defaults: Mapping[str, Any]
    own: Mapping[str, Any]
    """The stage's own settings, with `per_task`."""
    seed: int
    path: KeyPath
    """The stage's place in the document."""

    def at(self, point: PlacedPoint, findings: Findings) -> Point:
        """Settings at a point of the grid or the search."""
        runs, point = {}, field_by_field(point)
        # Settings are checked even if no task is valid.
        for task in self.tasks or (BUILT_IN_TASKS["FetchPush"],):
            layers, problems = merge(self.variant, task, self.defaults, self.own, self.path, point)
            findings.problems += problems
            changes = {"task": task.model_dump(), "variant": self.variant, "seed": self.seed}
            data = layers.data | changes
            try:
                runs[task.name] = from_json(RunSettings, data)
            except ValidationError as error:
                for path, rule in problems_of(error, data, RunSettings):
                    origin = layers.origin(path, self.path)
                    findings.problems.append(Problem(origin, for_a_grid(rule, path, data)))
        return Point(values={key: value for key, (_, value) in point.items()}, runs=runs)

    def resolve(self, values: Mapping[str, Any]) -> Point:
        """Settings at a point of plain values; for `Stage.resolve`.

        Raises:
            ConfigError: They are invalid; names the settings.
        """
        findings = Findings()
        point = self.at({name: ((name,), value) for name, value in values.items()}, findings)
        if findings.problems:
            lines = [f"{problem.path[-1]} {problem.rule}" for problem in findings.problems]
            raise ConfigError(list(dict.fromkeys(lines)))
        return point


def _check_defaults(defaults: Mapping[str, Any], findings: Findings) -> None:
    """Report the mistakes in `defaults` beside an invalid stage, whose settings are not checked."""
    found = Findings()
    settings = _StageSettings(
        variant="tac", tasks=(), defaults=defaults, own={"per_task": {}}, seed=0, path=()
    )
    settings.at({}, found)
    findings.problems += [one for one in found.problems if one.path[:1] == ("defaults",)]


def _header(raw: dict[str, Any], findings: Findings) -> StageHeader | None:
    known = (*StageHeader.model_fields, *all_settings())
    for key in raw.keys() - {*StageHeader.model_fields, *LAYER_KEYS}:
        findings.add((key,), unknown(key, known))
    values = {key: value for key, value in raw.items() if key in StageHeader.model_fields}
    if isinstance(values.get("init_from"), str):
        values["init_from"] = {"stage": values["init_from"]}
    header = findings.validate(StageHeader, values)
    grid = values.get("grid")
    for dotted, choices in grid.items() if isinstance(grid, dict) else ():
        findings.forbid_repeats(choices, ("grid", dotted))
    return header


def _check_per_task(header: StageHeader, tasks: tuple[Task, ...], findings: Findings) -> None:
    known = [task.name for task in tasks]
    for name, settings in header.per_task.items():
        if known and name not in known:  # otherwise the stage's tasks are a problem already
            rule = f"is not a task of this stage ({', '.join(known)})"
            findings.add(("per_task", name), rule)
        for key in settings.keys() - set(LAYER_KEYS):
            findings.add(("per_task", name, key), unknown(key, all_settings()))


def _grid_points(grid: Mapping[str, list[Any]]) -> list[PlacedPoint]:
    """The product of the grid's lists, the last key varying fastest."""
    axes = [
        [(("grid", key, position), value) for position, value in enumerate(grid[key])]
        for key in grid
    ]
    return [dict(zip(grid, combination, strict=True)) for combination in itertools.product(*axes)]


def _forbid_equal_points(points: tuple[Point, ...], findings: Findings) -> None:
    """Reject two points with the same settings, such as two spellings of one schedule."""
    seen = set()
    for point in points:
        runs = tuple(run.model_dump_json() for run in point.runs.values())
        if runs and runs in seen:
            findings.add(
                ("grid",), f"must not have two equal points, got {shown(point.values)} again"
            )
        seen.add(runs)


def _source(header: StageHeader, find_tasks: FindTasks, findings: Findings) -> Source | None:
    given, starts_from = header.init_from, VARIANTS[header.variant].starts_from
    if given is None:
        if starts_from != "scratch":
            rule = f"must be given for {header.variant}, which starts from a trained {starts_from}"
            findings.add((), rule)
        return None
    if starts_from == "scratch":
        findings.add((), f"has no effect with variant {header.variant}: it starts from scratch")
        return None
    task = None
    if given.task is not None:
        found = find_tasks([given.task], findings)
        if not found:
            return None
        task = found[0]
    if given.stage is not None:
        return Source(stage=given.stage, task=task)
    try:
        folder, manifest = open_handoff(Path(str(given.checkpoint)).expanduser().absolute())
    except HandoffError as error:
        findings.add(("checkpoint",), str(error))
        return None
    except RuntimeError:  # `~name/...`, and nobody has this name
        rule = f"must be in an existing home folder, got {shown(given.checkpoint)}"
        findings.add(("checkpoint",), rule)
        return None
    return Source(checkpoint=ImportedHandoff(folder=folder, manifest=manifest), task=task)


def _check_source(
    stage: Stage, source: Source, earlier: Mapping[str, Stage | None], findings: Findings
) -> None:
    if source.checkpoint is not None:
        _check_checkpoint(stage, source.checkpoint, source.task, findings.below("checkpoint"))
    elif source.stage not in earlier:
        known = f" (one of {', '.join(earlier)})" if earlier else ""
        hint = closest(str(source.stage), earlier)
        findings.add((), f"must be an earlier stage{known}, got {source.stage!r}{hint}")
    elif (above := earlier[str(source.stage)]) is not None and above.search is not None:
        findings.add(
            (),
            f"must be a stage whose runs are known beforehand, got {above.name!r}, which is "
            "searched; start from its best trial's handoff with {checkpoint: FOLDER}",
        )
    elif above is not None:
        _check_stage(stage, source.task, above, findings)


def _check_checkpoint(
    stage: Stage, checkpoint: ImportedHandoff, task: Task | None, findings: Findings
) -> None:
    made_for = checkpoint.manifest.info.task
    for wanted in [task] if task else stage.tasks:
        if differences := task_differences(made_for, wanted):
            rule = f"must be of task {wanted.name}, got one of {made_for.name}; "
            if wanted.name == made_for.name:  # of another sweep, which declares it differently
                rule += "; ".join(differences)
            else:
                rule += f"to start from it, add 'task: {made_for.name}'"
            findings.add((), rule)
    problems_before = len(findings.problems)
    for _, point in stage.examples():
        theirs = checkpoint.manifest.info.architecture
        for run in point.runs.values():
            _check_fit(stage, run, made_for, theirs, str(checkpoint.folder), findings)
    if len(findings.problems) > problems_before:
        return
    for needed in {handed_over(run) for point in stage.points for run in point.runs.values()}:
        try:
            read_handoff(checkpoint.folder, needed, made_for)
        except HandoffError as error:
            findings.add((), str(error))


def _check_stage(stage: Stage, task: Task | None, above: Stage, findings: Findings) -> None:
    estimator = VARIANTS[stage.variant].starts_from == "estimator"
    if estimator and not VARIANTS[above.variant].uses_mi:
        rule = f"must be a stage with an estimator, got {above.name!r}, which is {above.variant}"
        findings.add((), rule)
        return
    networks = VARIANTS[stage.variant].starts_from == "intrinsic"
    without = [run for at in above.points for run in at.runs.values() if not run.intrinsic.reward]
    if networks and without:
        rule = f"must be a stage with intrinsic.reward, got {above.name!r}, which has none"
        findings.add((), rule)
        return
    known = sorted({task.name for task in above.tasks})
    for own in stage.tasks:
        wanted = task or own
        if wanted.name not in known:
            findings.add(
                (),
                f"needs a run of {wanted.name} in stage {above.name}, whose tasks are "
                f"{', '.join(known)}; name one: {{stage: {above.name}, task: ...}}",
            )
    for values, point in stage.examples():
        searched = of_stage(values, above.name)
        with contextlib.suppress(ConfigError):  # invalid values are a problem of their own
            # A source whose settings are searched has one point.
            whole = {**above.points[0].values, **searched}
            for source in [above.resolve(whole)] if searched else above.points:
                for name, run in point.runs.items():
                    theirs = source.runs.get(task.name if task else name)
                    if theirs is not None:  # a problem of its own, above
                        origin = f"stage {above.name}"
                        _check_fit(stage, run, theirs.task, theirs.architecture, origin, findings)


def _check_fit(
    stage: Stage,
    run: RunSettings,
    task: Task,
    architecture: Architecture,
    origin: str,
    findings: Findings,
) -> None:
    """The architecture and the split of a run must equal those of its source."""
    starts_from = VARIANTS[stage.variant].starts_from
    for name in architecture.differences(run.architecture, starts_from):
        findings.add((), f"needs the same {name} in stage {stage.name} as in {origin}")
    ours, theirs = (
        (len(one.agent_indices), len(one.surrounding_indices)) for one in (run.task, task)
    )
    if starts_from == "estimator" and ours != theirs:
        findings.add(
            (),
            f"needs as many agent and surrounding indices in {run.task.name} as in {task.name} "
            f"({origin}): {ours} and {theirs}",
        )
