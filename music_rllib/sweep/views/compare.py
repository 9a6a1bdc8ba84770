"""The answer of `compare`, as plain data and as text with tables."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from music_rllib import names
from music_rllib.errors import BadInputError
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.names import ShortLabels
from music_rllib.results.analysis import analyse_stage, mixed
from music_rllib.results.answer import answer, study_data
from music_rllib.results.conditions import find_stages
from music_rllib.results.read import SweepRead, read_stored
from music_rllib.results.study import study_of
from music_rllib.results.tables import performance_tables, study_tables
from music_rllib.search.best import ranking_metric
from music_rllib.sweep.views.results import console_table


def compare_stage(
    location: SweepLocation, stage: str | None, metric: str | None, *, minimize: bool
) -> tuple[dict[str, Any], RenderableType]:
    """The comparison of a stage's conditions as plain data, and as text with tables.

    Args:
        stage: Name of the stage; None: that of the recorded analysis plan, or the last that trains
            for the task.
        metric: The compared metric; None: the objective's, or the primary one of each task.
        minimize: Lower values of the metric are better.

    Raises:
        BadInputError: There is no such stage or metric.
    """
    config = location.config()
    stages = {one.name: one for one in config.stages}
    metrics = {task.primary_metric for each in config.stages for task in each.tasks}
    metrics |= {names.EVAL_EPISODES, *names.ENTROPIES, *filter(None, [metric])}
    metrics |= {one.search.objectives[0].metric for one in stages.values() if one.search}
    read = read_stored(location, metrics=metrics)
    sweep = read.sweep
    study = study_of(sweep) if stage is None else None  # as in the report
    if study is not None:
        # Stages side by side have a name of their own.
        known = [study.stage and study.stage.name, *(one.plan.stage for one in sweep.plans[-1:])]
        stage = next((name for name in known if name in stages), None)
    settings = config.stage(stage)
    ranking = ranking_metric(settings, sweep)
    shown = metric or (ranking.metric if settings.search else None)
    maximised = not minimize and (ranking.maximised or shown != ranking.metric)
    if study is None or metric is not None:
        higher = maximised or metric is None
        study = study_of(sweep, settings.name, metric=metric, maximised=higher)
    short = ShortLabels.of(run.name for run in sweep.runs)
    compared = {settings.name, *(sweep.runs[run].stage for run in study.runs)}
    environments = [*mixed((run for run in sweep.runs if run.stage in compared), short)]
    document = {
        "sweep": sweep.name,
        "stage": settings.name,
        "metric": shown or ranking.metric,
        "direction": "maximize" if maximised else "minimize",
        "answer": answer(sweep, study),
        "environments": environments,
        **study_data(study),
        "earlier": sweep.earlier,
    }
    earlier = [Text(sweep.earlier)] if sweep.earlier else []
    own = next((one for one in find_stages(sweep) if one.name == settings.name), None)
    of_stage = study.stage or own
    final = analyse_stage(sweep, of_stage, shown) if of_stage else None
    if final is None or not any(scope.finals for scope in final.scopes):
        if metric is not None:
            _check_metric(read, settings.name, metric)
        text = f"Stage {settings.name} of {sweep.name} has no finished run yet."
        if any(run.is_finished and run.stage == settings.name for run in sweep.runs):
            text = f"No run of stage {settings.name} has reported {shown or ranking.metric}."
        planned = map(Text, document["answer"] if study.claims else ())
        return document, Group(*planned, Text(text), *earlier)
    lines: list[RenderableType] = [*map(Text, document["answer"]), *earlier, Text()]
    lines += [Text(line, style="yellow") for line in environments]
    if final.stage.compared != final.stage.conditions:
        lines.append(Text("Runs of a search selected its trials: the best is biased upwards."))
    finals, entropies, *_ = performance_tables([final])
    for table in (*study_tables(study), finals, entropies):
        if table.rows:
            lines += [console_table(table), Text()]
    return document, Group(*lines)


def _check_metric(read: SweepRead, stage: str, metric: str) -> None:
    """Refuse a metric that no finished run of the stage has; another stage's runs may have it."""
    if read.opened is None:
        return
    results = read.opened.results()
    own = (results.get(node.key) for node in read.opened.plan.nodes if node.stage == stage)
    known = sorted({name for result in own if result is not None for name in result.metrics})
    if known and metric not in known:
        raise BadInputError(
            f"--metric must be one of {', '.join(known)} in stage {stage}, got {metric!r}"
        )
