"""The answer of `compare`, as plain data and as text with tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from music_rllib import names
from music_rllib.errors import BadInputError
from music_rllib.experiment.sweep_files import SweepLocation
from music_rllib.names import ShortLabels
from music_rllib.results.analysis import StageAnalysis, analyse_stage, mixed
from music_rllib.results.answer import answer, study_data
from music_rllib.results.conditions import find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.read import StoredSweep, read_stored
from music_rllib.results.study import Study, study_of
from music_rllib.results.tables import performance_tables, study_tables
from music_rllib.search.best import ranking_metric
from music_rllib.sweep.views.results import console_table


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The comparison of a stage's conditions."""

    sweep: Sweep
    stage: str
    metric: str
    maximised: bool
    study: Study
    final: StageAnalysis | None
    """Final values of the stage by the metric; None while it has no finished run."""

    @property
    def environments(self) -> list[str]:
        """Sentences about tasks whose runs used different versions of an environment."""
        short = ShortLabels.of(run.name for run in self.sweep.runs)
        return list(
            mixed(
                (run.task, short(run.name), run.tags.get(names.TAG_ENVIRONMENT, ""))
                for run in self.sweep.runs
                if run.is_finished and run.stage == self.stage
            )
        )

    def document(self) -> dict[str, Any]:
        """The comparison as plain data."""
        return {
            "sweep": self.sweep.name,
            "stage": self.stage,
            "metric": self.metric,
            "direction": "maximize" if self.maximised else "minimize",
            "answer": answer(self.sweep, self.study),
            "environments": self.environments,
            **study_data(self.study),
            "earlier": self.sweep.earlier,
        }

    def view(self) -> RenderableType:
        """The answer, the comparisons, and the final values and entropies of the conditions."""
        earlier = [Text(self.sweep.earlier)] if self.sweep.earlier else []
        if self.final is None:
            text = f"Stage {self.stage} of {self.sweep.name} has no finished run yet."
            return Group(Text(text), *earlier)
        lines: list[RenderableType] = [*map(Text, answer(self.sweep, self.study)), *earlier, Text()]
        lines += [Text(line, style="yellow") for line in self.environments]
        finals, entropies, *_ = performance_tables([self.final])
        tables = [*study_tables(self.study), finals, entropies]
        if self.final.stage.compared != self.final.stage.conditions:
            lines.append(Text("Runs of a search selected its trials: the best is biased upwards."))
        for table in tables:
            if table.rows:
                lines += [console_table(table), Text()]
        return Group(*lines)


def compare_stage(
    location: SweepLocation, stage: str | None, metric: str | None, *, minimize: bool
) -> Comparison:
    """Compare the conditions of a stage.

    Args:
        location: The sweep.
        stage: Name of the stage; None: the stage of the analysis, or the last one.
        metric: The compared metric; None: the objective's, or the primary one of each task.
        minimize: Lower values of the metric are better.

    Raises:
        BadInputError: There is no such stage or metric.
    """
    config = location.config()
    settings = config.stage(stage)
    metrics = {task.primary_metric for each in config.stages for task in each.tasks}
    metrics |= {names.EVAL_EPISODES, *names.ENTROPIES, *filter(None, [metric])}
    if settings.search is not None:
        metrics.add(settings.search.objectives[0].metric)
    read = read_stored(location, metrics=metrics)
    if metric is not None:
        _check_metric(read, metric)
    ranking = ranking_metric(settings, read.sweep)
    shown = metric or (ranking.metric if settings.search else None)
    maximised = not minimize and (ranking.maximised or shown != ranking.metric)
    found = (one for one in find_stages(read.sweep) if one.name == settings.name)
    final = next((analyse_stage(read.sweep, one, shown) for one in found), None)
    return Comparison(
        sweep=read.sweep,
        stage=settings.name,
        metric=shown or ranking.metric,
        maximised=maximised,
        study=study_of(
            read.sweep, settings.name, metric=metric, maximised=maximised or metric is None
        ),
        final=final if final and any(scope.finals for scope in final.scopes) else None,
    )


def _check_metric(read: StoredSweep, metric: str) -> None:
    if metric not in read.sweep.history and any(read.opened.finished):
        results = read.opened.results().values()
        known = sorted({name for result in results for name in result.metrics})
        raise BadInputError(f"--metric must be one of {', '.join(known)}, got {metric!r}")
