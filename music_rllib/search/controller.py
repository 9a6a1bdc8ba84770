"""The controller of a sweep's searches: from trials to runs, values, and runs on fresh seeds."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import ConfigError
from music_rllib.config.search import FINAL_SEED, SearchSettings
from music_rllib.errors import first_line
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node, Run
from music_rllib.experiment.scheduler import DONE, LOST, Listener, Status
from music_rllib.redaction import redact
from music_rllib.search.objective import aggregates, prune, score
from music_rllib.search.storage import DATABASE_ERRORS
from music_rllib.search.study_record import SCORES, VALUES
from music_rllib.search.trials import Active, Arm, Array, Finalist, Search, ranked, up_to
from music_rllib.store.history import Report
from music_rllib.store.storage import DamagedError

POLL_SECONDS = 1.0
"""Time between two looks at the trials of other drivers."""


class SearchController(Listener):
    """Fills the scheduler with the runs that the searches want next, and judges finished ones."""

    def __init__(
        self,
        sweep: OpenSweep,
        searches: Sequence[Search],
        *,
        reused: Callable[[Node], None] = lambda node: None,
        pruned: Callable[[Node, str], None] = lambda node, reason: None,
        say: Callable[[str], None] = lambda text: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Control the searches of `sweep`.

        Args:
            sweep: Its plan and scheduler grow.
            searches: The opened searches.
            reused: Called with each wanted node that is in the store already.
            pruned: Called with each node that is computed no further, and the reason.
            say: Called with one line about the end of each trial.
            now: A clock in seconds.
        """
        self.searches = list(searches)
        self._scheduler, self._plan, self._store = sweep.scheduler, sweep.plan, sweep.store
        self._environments = sweep.environments
        self._reused, self._pruned, self._say, self._now = reused, pruned, say, now
        self._reports: dict[str, dict[int, Report]] = {}
        """Reports of unfinished runs, by node key and environment step."""
        self._changes_seen = -1
        self._polled = -POLL_SECONDS
        self._more = True
        self._database_lost = False
        """Whether the last look at the database failed."""

    @property
    def over(self) -> bool:
        """Whether every search has its ranking, or can't have one."""
        return all(search.over for search in self.searches)

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Keep the reports by which a trial may be judged before its runs have finished."""
        if node.part:
            self._reports.setdefault(node.key, {}).update(
                {report.env_steps: report for report in reports}
            )

    def tick(self) -> None:
        """Show other drivers that this one lives, also while Tune asks for nothing."""
        for search in self.searches:
            for arm in search.arms:
                with contextlib.suppress(*DATABASE_ERRORS):
                    arm.study.sign()

    def advance(self) -> bool:
        """Judge the trials that can be judged, and ask the scheduler for what is wanted next.

        Returns:
            Whether more may be wanted later.
        """
        now = self._now()
        if self._changes_seen == self._scheduler.changes and now - self._polled < POLL_SECONDS:
            return self._more
        self._polled = now
        try:
            self._advance_all()
        except DATABASE_ERRORS as error:
            # What was begun is begun again next time; runs go on meanwhile.
            if not self._database_lost:
                cause = first_line(error.__cause__ or error)
                self._say(f"the study's database does not answer, trying again: {redact(cause)}")
            self._database_lost = True
            return True
        self._database_lost = False
        self._changes_seen = self._scheduler.changes
        self._more = not self.over
        return self._more

    def _advance_all(self) -> None:
        for search in self.searches:
            for arm in search.arms:
                arm.study.refresh()
        while True:
            before = self._scheduler.changes
            moved = [self._advance(search) for search in self.searches]
            if not any(moved) and before == self._scheduler.changes:
                break

    def _advance(self, search: Search) -> bool:
        moved = False
        for arm in search.arms:
            arm.study.sign()
            for active in list(arm.active.values()):
                moved |= self._judge(arm, active)
            # Only what this driver has room for: the rest is for others.
            while self._scheduler.next_ready() is None:
                trial = arm.study.claim()
                if trial is None:
                    break
                moved = True
                arm.active[trial.number] = Active(trial)
                self._want_rung(arm, arm.active[trial.number])
        if all(arm.finalists is None and arm.ended for arm in search.arms):
            self._recall(search)
            for arm in search.arms:
                arm.finalists = self._choose(arm)
            moved = True
        for arm in search.arms:
            for finalist in arm.finalists or ():
                moved |= self._judge_finalist(search.settings, finalist)
        return moved

    def stop(self) -> None:
        """Give this driver's trials back, and add those of other drivers to the plan."""
        for search in self.searches:
            for arm in search.arms:
                with contextlib.suppress(*DATABASE_ERRORS):  # they are taken over in any case
                    arm.study.release()
        with contextlib.suppress(*DATABASE_ERRORS):  # the plan lacks what others have judged
            self.recall()

    def recall(self) -> None:
        """Add the runs of all ended trials to the plan, which other drivers may have judged."""
        for search in self.searches:
            self._recall(search)

    def _recall(self, search: Search) -> None:
        for arm in search.arms:
            for trial in arm.study.trials():
                if not trial.state.is_finished() or VALUES not in trial.user_attrs:
                    continue
                reached = max(map(int, trial.user_attrs.get(SCORES, {})), default=0)
                rung = search.rungs[min(reached, len(search.rungs) - 1)]
                try:
                    runs = self._plan_runs(arm, trial, self._plan.seeds[: rung.seeds])
                except ConfigError:
                    continue  # that is why it failed
                for node in (node for run in runs for node in self._nodes_of(run)):
                    if not self._scheduler.knows(node.key):
                        finished = self._store.is_finished(node.key)
                        self._scheduler.add_pruned(node, finished=finished)
                        if finished:
                            self._reused(node)

    # -- runs --------------------------------------------------------------------------------

    def _plan_runs(
        self, arm: Arm, trial: FrozenTrial, seeds: Sequence[int], phase: str = "trial"
    ) -> list[Run]:
        """The runs of a trial, which are added to the plan; arms take turns in its numbers.

        Raises:
            ConfigError: Its point makes no valid settings.
        """
        number = trial.number * len(arm.search.arms) + arm.position
        part = f"{phase}{trial.number}"
        return self._plan.add_trial(arm.search.stage.name, number, arm.point(trial), seeds, part)

    def _nodes_of(self, run: Run) -> list[Node]:
        """The node of a run, after the planned node that it starts from, if there is one."""
        node = self._plan.node(run.key)
        if node.input is None or node.input.checkpoint is not None:
            return [node]
        return [self._plan.node(node.input.key), node]

    def _want(self, run: Run, until: int | None) -> None:
        for node in self._nodes_of(run):
            new = not self._scheduler.knows(node.key)
            # One that is damaged is handed out: the worker that finds it there says what is wrong.
            # So does one of another environment.
            finished = new and self._store.is_sound(node.key) and self._is_of_now(node)
            paused = node.key == run.key and until is not None and until < node.run.env_steps
            self._scheduler.request(node, until if paused else None, finished=finished)
            if finished:
                self._reused(node)

    def _is_of_now(self, node: Node) -> bool:
        task, found = node.run.task.name, self._store.environment(node.key)
        return not self._environments.differences(task, found)

    def _want_rung(self, arm: Arm, active: Active) -> None:
        """Ask for the runs up to the trial's rung."""
        rung = arm.search.rungs[active.rung]
        try:
            active.runs = self._plan_runs(arm, active.trial, self._plan.seeds[: rung.seeds])
        except ConfigError as error:
            self._end(arm, active, TrialState.FAIL, "; ".join(error.lines))
            return
        for run in active.runs:
            self._want(run, rung.env_steps)

    # -- trials ------------------------------------------------------------------------------

    def _judge(self, arm: Arm, active: Active) -> bool:
        """End a trial or move it to its next rung; False where its runs are not there yet."""
        search = arm.search
        states = {run.key: self._scheduler[run.key] for run in active.runs}
        lost = [run for run in active.runs if states[run.key] in LOST]
        if lost:
            why = f"{lost[0].label} {states[lost[0].key]}"
            self._end(arm, active, TrialState.FAIL, why, lost=True)
            return True
        if not all(state in DONE or state is Status.PAUSED for state in states.values()):
            return False
        try:
            scores = self._scores(search.settings, active.runs, search.rungs[active.rung].env_steps)
        except (ValueError, DamagedError) as error:
            self._end(arm, active, TrialState.FAIL, str(error))
            return True
        values = aggregates(search.settings.objectives, scores)
        value = values[0] if len(values) == 1 else None
        kept = [of_objective.tolist() for of_objective in scores]
        arm.study.report(active.trial, active.rung, value, kept)
        if active.rung == len(search.rungs) - 1:
            self._end(arm, active, TrialState.COMPLETE, values=values)
        elif (reason := self._prunes(arm, active, scores[0])) is not None:
            self._end(arm, active, TrialState.PRUNED, reason)
        else:
            active.rung += 1
            self._want_rung(arm, active)
        return True

    def _scores(
        self, settings: SearchSettings, runs: Sequence[Run], until: int | None
    ) -> list[Array]:
        """Scores `[seeds, tasks]` for each objective; `runs` has those of a seed together.

        Raises:
            ValueError: A run has no number for an objective.
        """
        tasks = len({run.task for run in runs})
        scores: list[list[float]] = [[] for _ in settings.objectives]
        for run in runs:
            history = up_to(self._history(run.key), until)
            budget = until or self._plan.node(run.key).run.env_steps
            for objective, numbers in zip(settings.objectives, scores, strict=True):
                try:
                    numbers.append(score(objective, history, budget))
                except ValueError as error:
                    raise ValueError(f"{run.label}: {error}") from error
        return [np.asarray(numbers).reshape(-1, tasks) for numbers in scores]

    def _history(self, key: str) -> list[Report]:
        if self._scheduler[key] in DONE:
            return self._store.history(key)
        return [report for _, report in sorted(self._reports.get(key, {}).items())]

    def _prunes(self, arm: Arm, active: Active, scores: Array) -> str | None:
        """Why the trial is stopped at its rung; None: it goes on.

        It is compared with the trials that had all ended when it was chosen, so that the answer
        doesn't depend on who was faster.
        """
        search, number = arm.search, active.trial.number
        pruning = search.settings.pruning
        assert pruning is not None
        if number < pruning.warm_up:
            return None
        earlier = arm.study.trials()[: max(0, number - search.settings.concurrent + 1)]

        def scores_at(rung: int) -> dict[int, Array]:
            kept = {trial.number: trial.user_attrs.get(SCORES, {}) for trial in earlier}
            return {n: np.asarray(at[str(rung)][0]) for n, at in kept.items() if str(rung) in at}

        env_steps = search.rungs[active.rung].env_steps
        steps = "" if env_steps is None else f" after {env_steps:,} env steps"
        verdict = prune(
            search.settings.objectives[0],
            pruning,
            scores=scores,
            others=scores_at(active.rung),
            whole=scores_at(len(search.rungs) - 1),
            place=f"with {scores.shape[0]} of {len(self._plan.seeds)} seeds{steps}",
        )
        return verdict.reason if verdict.stop else None

    def _end(
        self,
        arm: Arm,
        active: Active,
        state: TrialState,
        reason: str = "",
        values: Sequence[float] | None = None,
        *,
        lost: bool = False,
    ) -> None:
        """Record the end of a trial, and compute those of its runs no further that no other has."""
        arm.study.end(active.trial, state, values, reason, lost=lost)
        del arm.active[active.trial.number]
        if state is TrialState.COMPLETE:
            text = ", ".join(f"{value:.4g}" for value in values or ())
        else:
            text = f"{'stopped early' if state is TrialState.PRUNED else 'FAILED'}, {reason}"
        self._say(f"{arm.label} trial {active.trial.number}: {text}")
        arms = (arm for search in self.searches for arm in search.arms)
        wanted = {run.key for arm in arms for other in arm.active.values() for run in other.runs}
        for run in active.runs:
            if run.key in wanted or self._scheduler.is_planned(run.key):
                continue
            self._reports.pop(run.key, None)
            if self._scheduler.prune(run.key):
                self._pruned(self._plan.node(run.key), reason)

    # -- the final ranking -------------------------------------------------------------------

    def _choose(self, arm: Arm) -> list[Finalist]:
        """The best trials of an ended study, and its baselines, to be run on fresh seeds."""
        settings = arm.search.settings
        final = settings.final
        if final is None:
            return []
        seeds = range(FINAL_SEED, FINAL_SEED + final.seeds)
        finalists: list[Finalist] = []
        for trial in ranked(settings, arm.study.trials()):
            values = arm.point(trial)
            if any(finalist.values == values for finalist in finalists):
                continue  # the same point twice is one finalist
            # The given points are the study's first trials.
            baseline = final.baselines and trial.number < len(settings.points_to_evaluate)
            if len(finalists) >= final.trials and not baseline:
                continue
            runs = self._plan_runs(arm, trial, seeds, phase="final")
            for run in runs:
                self._want(run, None)
            searched = tuple(trial.values or ())
            finalists.append(
                Finalist(number=trial.number, values=values, searched=searched, runs=runs)
            )
        return finalists

    def _judge_finalist(self, settings: SearchSettings, finalist: Finalist) -> bool:
        """Read a finalist's scores; False where it has them already, or its runs are missing."""
        if finalist.over:
            return False
        states = [self._scheduler[run.key] for run in finalist.runs]
        if any(state in LOST for state in states):
            finalist.failure = "a run on fresh seeds failed"
        elif all(state in DONE for state in states):
            try:
                finalist.scores = self._scores(settings, finalist.runs, None)
            except (ValueError, DamagedError) as error:
                finalist.failure = str(error)
        return finalist.over
