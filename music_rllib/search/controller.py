"""The controller of a sweep's searches: from trials to runs, values, and runs on fresh seeds."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import ConfigError
from music_rllib.config.search import FINAL_SEED, SearchSettings
from music_rllib.errors import first_line
from music_rllib.experiment.open_sweep import OpenSweep
from music_rllib.experiment.plan import Node
from music_rllib.experiment.scheduler import DONE, LOST, Failure, Listener, Status
from music_rllib.redaction import redact
from music_rllib.results.statistics import Array
from music_rllib.search.objective import aggregate, reason_to_prune, score, up_to
from music_rllib.search.sampler import VALUES
from music_rllib.search.searches import DATABASE_ERRORS, Finalist, RunningTrial, Search
from music_rllib.search.study import SCORES, OptunaStudy
from music_rllib.store.history import Report, RunResult
from music_rllib.store.storage import DamagedError

POLL_SECONDS = 1.0
"""Time between two looks at the trials of other drivers."""


class SearchController(Listener):
    """Ends a trial when the last of its runs ends, and claims the next one when a run is wanted.

    A trial's point depends only on the trials up to its number minus `concurrent`, and pruning on
    the trials that had ended when it was proposed: the order of events does not matter.
    """

    def __init__(
        self,
        sweep: OpenSweep,
        searches: Sequence[Search],
        *,
        reused: Callable[[Node], None] = lambda node: None,
        pruned: Callable[[Node, str], None] = lambda node, reason: None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Control the searches of `sweep`, whose plan and scheduler grow.

        `reused` is called with each requested node that is already in the store, `pruned` with each
        node that is not computed any further and the reason, `say` with a line at each trial's end.
        """
        self.searches = list(searches)
        self._scheduler, self._plan, self._store = sweep.scheduler, sweep.plan, sweep.store
        self._environments, self._removed = sweep.environments, sweep.removed
        self._reused, self._pruned, self._say = reused, pruned, say
        self._reports: dict[str, dict[int, Report]] = {}
        """Reports of unfinished runs, by node key and environment step."""
        self._refreshed = time.monotonic()
        self._database_lost = False
        """Whether the database did not answer the last time."""

    @property
    def over(self) -> bool:
        """Whether every search has its ranking, or can't have one."""
        return all(search.over for search in self.searches)

    # -- events ------------------------------------------------------------------------------

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Keep the reports of a run, which may be scored before it has finished."""
        if node.part:
            by_step = {report.env_steps: report for report in reports}
            self._reports.setdefault(node.key, {}).update(by_step)

    def finished(self, node: Node, result: RunResult) -> None:
        self._score_trials()

    def paused(self, node: Node) -> None:
        self._score_trials()

    def failed(self, node: Node, failure: Failure) -> None:
        self._score_trials()

    def tick(self) -> None:
        """Regularly look at the trials of other drivers."""
        now = time.monotonic()
        if now - self._refreshed >= POLL_SECONDS:
            self._refreshed = now
            self.refresh()

    def refresh(self) -> None:
        """Show other drivers that this one is alive, and read their trials."""
        with self._database():
            for search in self.searches:
                for study in search.studies:
                    study.heartbeat()
                    study.refresh()
            self.recall()
        self._score_trials()

    def propose(self) -> None:
        """Claim trials until a run is ready, unless the next trial must wait for earlier ones.

        Claims no more trials than this driver can run now, and leaves the others to other drivers.
        """
        self._score_trials()
        while self._scheduler.next_ready() is None and not self._is_blocked() and self._claim():
            self._score_trials()

    def _is_blocked(self) -> bool:
        """Whether a claimed trial only waits for its input, as the next one would."""
        return any(
            one.runs and all(self._scheduler.waits_for_input(run.key) for run in one.runs)
            for search in self.searches
            for one in search.running
        )

    def stop(self) -> None:
        """Release this driver's trials, and add those of other drivers to the plan."""
        for search in self.searches:
            for study in search.studies:
                with contextlib.suppress(*DATABASE_ERRORS):  # they are taken over in any case
                    study.release()
        with contextlib.suppress(*DATABASE_ERRORS):  # the plan lacks the trials of other drivers
            for search in self.searches:  # begun ones, too: `clean` finds their checkpoints
                self._recall(search, with_begun=True)

    def recall(self) -> None:
        """Add the runs of all ended trials to the plan; other drivers may have run them."""
        for search in self.searches:
            self._recall(search)

    @contextlib.contextmanager
    def _database(self) -> Iterator[None]:
        """Print a warning if the database does not answer; the next event tries again."""
        try:
            yield
        except DATABASE_ERRORS as error:
            if not self._database_lost:
                cause = first_line(error.__cause__ or error)
                self._say(f"the study's database does not answer, trying again: {redact(cause)}")
            self._database_lost = True
        else:
            self._database_lost = False

    # -- runs --------------------------------------------------------------------------------

    def _recall(self, search: Search, *, with_begun: bool = False) -> None:
        for study in search.studies:
            for trial in study.trials():
                if VALUES not in trial.user_attrs or trial._trial_id in search.recalled:
                    continue
                if has_ended := trial.state.is_finished():
                    search.recalled.add(trial._trial_id)
                if has_ended or with_begun:
                    with contextlib.suppress(ConfigError):  # the reason why the trial failed
                        self._recall_trial(search, study, trial, has_ended=has_ended)

    def _recall_trial(
        self, search: Search, study: OptunaStudy, trial: FrozenTrial, *, has_ended: bool
    ) -> None:
        reached = max(map(int, trial.user_attrs.get(SCORES, {})), default=-1)
        reached = max(reached, 0) if has_ended else reached + 1
        rung = search.rungs[min(reached, len(search.rungs) - 1)]
        runs = self._plan_runs(search, study, trial, self._plan.seeds[: rung.seeds])
        # A pruned trial has finished its runs if its rung is one of seeds.
        complete = (TrialState.COMPLETE, *[TrialState.PRUNED] * (rung.env_steps is None))
        for run in runs if trial.state in complete else ():
            chain = {node.key for node in self._plan.chain(run.key)}
            if any(not self._scheduler.knows(key) for key in chain & self._removed):
                self._request(run, None)  # the trial keeps its score
        for node in (node for run in runs for node in self._plan.chain(run.key)):
            if self._scheduler.knows(node.key):
                continue
            finished = self._store.is_finished(node.key)
            if not has_ended:
                self._scheduler.request(node, None, finished=finished)
                continue
            self._scheduler.add_pruned(node, finished=finished)
            if finished:
                self._reused(node)

    def _plan_runs(
        self,
        search: Search,
        study: OptunaStudy,
        trial: FrozenTrial,
        seeds: Sequence[int],
        phase: str = "trial",
    ) -> list[Node]:
        """The runs of a trial, which are added to the plan; the studies' trials alternate there.

        Raises:
            ConfigError: The settings of its point are not valid.
        """
        number = trial.number * len(search.studies) + search.studies.index(study)
        part = f"{phase}{trial.number}"
        return self._plan.add_trial(search.stage.name, number, study.point(trial), seeds, part)

    def _request(self, run: Node, until: int | None) -> None:
        """Ask for a run up to an environment step; None: to its end."""
        for node in self._plan.chain(run.key):
            new = not self._scheduler.knows(node.key)
            # A damaged node, or one of another environment, goes to a worker, which reports it.
            finished = new and self._store.is_sound(node.key) and self._is_current(node)
            pauses = node.key == run.key and until is not None and until < node.run.env_steps
            self._scheduler.request(node, until if pauses else None, finished=finished)
            if finished:
                self._reused(node)

    def _is_current(self, node: Node) -> bool:
        """Whether a node in the store was computed with the environment of today."""
        found = self._store.environment(node.key)
        return not self._environments.differences(node.run.code, found)

    def _request_rung(self, search: Search, one: RunningTrial) -> None:
        """Ask for the runs up to the trial's rung."""
        rung = search.rungs[one.rung]
        seeds = self._plan.seeds[: rung.seeds]
        try:
            one.runs = self._plan_runs(search, one.study, one.trial, seeds)
        except ConfigError as error:
            self._end(search, one, TrialState.FAIL, "; ".join(error.lines))
            return
        for run in one.runs:
            self._request(run, rung.env_steps)

    # -- trials ------------------------------------------------------------------------------

    def _claim(self) -> bool:
        """Claim one trial, and ask for its runs; False if none can be claimed now."""
        with self._database():
            for search in self.searches:
                for study in search.studies:
                    if (trial := study.claim()) is not None:
                        one = RunningTrial(study, trial)
                        search.running.append(one)
                        self._request_rung(search, one)
                        return True
        return False

    def _score_trials(self) -> None:
        """Score the trials whose runs have all ended, and choose finalists after the last one."""
        with self._database():
            changed = True
            while changed:
                changed = False
                for search in self.searches:
                    changed |= self._advance(search)

    def _advance(self, search: Search) -> bool:
        changed = False
        for one in list(search.running):
            changed |= self._score_trial(search, one)
        if search.finalists is None and all(study.has_ended for study in search.studies):
            self._recall(search)
            search.finalists = [
                one for study in search.studies for one in self._choose(search, study)
            ]
            changed = True
        for finalist in search.finalists or ():
            changed |= self._score_finalist(search.settings, finalist)
        return changed

    def _score_trial(self, search: Search, one: RunningTrial) -> bool:
        """End a trial or move it to its next rung; False if its runs have not ended yet."""
        states = {run.key: self._scheduler[run.key] for run in one.runs}
        lost = [run for run in one.runs if states[run.key] in LOST]
        if lost:
            why = f"{lost[0].label} {states[lost[0].key]}"
            self._end(search, one, TrialState.FAIL, why, lost=True)
            return True
        if not all(state in DONE or state is Status.PAUSED for state in states.values()):
            return False
        objectives = search.settings.objectives
        try:
            scores = self._scores(search.settings, one.runs, search.rungs[one.rung].env_steps)
        except (ValueError, DamagedError) as error:
            self._end(search, one, TrialState.FAIL, str(error))
            return True
        values = [aggregate(*pair) for pair in zip(objectives, scores, strict=True)]
        kept = [of_objective.tolist() for of_objective in scores]
        one.study.report(one.trial, one.rung, values[0] if len(values) == 1 else None, kept)
        if one.rung == len(search.rungs) - 1:
            self._end(search, one, TrialState.COMPLETE, values=values)
        elif (reason := self._reason_to_prune(search, one, scores[0])) is not None:
            self._end(search, one, TrialState.PRUNED, reason)
        else:
            one.rung += 1
            self._request_rung(search, one)
        return True

    def _scores(
        self, settings: SearchSettings, runs: Sequence[Node], until: int | None
    ) -> list[Array]:
        """Scores `[seeds, tasks]` for each objective; `runs` has those of a seed together.

        Raises:
            ValueError: A run has no number for an objective.
        """
        tasks = len({run.task for run in runs})
        scores: list[list[float]] = [[] for _ in settings.objectives]
        for run in runs:
            history = up_to(self._history(run.key), until)
            budget = self._plan.node(run.key).run.env_steps
            budget = min(until or budget, budget)
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

    def _reason_to_prune(self, search: Search, one: RunningTrial, scores: Array) -> str | None:
        """Why the trial is stopped at its rung; None if it continues.

        It is compared with the trials that had all ended when it was proposed.
        """
        number, pruning = one.trial.number, search.settings.pruning
        assert pruning is not None
        if number < pruning.warm_up:
            return None
        earlier = one.study.trials()[: max(0, number - search.settings.concurrent + 1)]

        def scores_at(rung: int) -> dict[int, Array]:
            kept = {trial.number: trial.user_attrs.get(SCORES, {}) for trial in earlier}
            return {n: np.asarray(at[str(rung)][0]) for n, at in kept.items() if str(rung) in at}

        env_steps = search.rungs[one.rung].env_steps
        steps = "" if env_steps is None else f" after {env_steps:,} env steps"
        return reason_to_prune(
            search.settings.objectives[0],
            pruning,
            scores=scores,
            others=scores_at(one.rung),
            whole=scores_at(len(search.rungs) - 1),
            rung=f"with {scores.shape[0]} of {len(self._plan.seeds)} seeds{steps}",
        )

    def _end(
        self,
        search: Search,
        one: RunningTrial,
        state: TrialState,
        reason: str = "",
        values: Sequence[float] | None = None,
        *,
        lost: bool = False,
    ) -> None:
        """Record the end of a trial, and stop those of its runs that no other trial needs."""
        one.study.end(one.trial, state, values, reason, lost=lost)
        search.running.remove(one)
        if state is TrialState.COMPLETE:
            text = ", ".join(f"{value:.4g}" for value in values or ())
        else:
            text = f"{'stopped early' if state is TrialState.PRUNED else 'FAILED'}, {reason}"
        self._say(f"{search.label(one.study)} trial {one.trial.number}: {text}")
        needed = {run.key for each in self.searches for other in each.running for run in other.runs}
        # Each run before the runs that it starts from, which other runs may need.
        for node in (node for run in one.runs for node in reversed(self._plan.chain(run.key))):
            planned = self._scheduler.is_planned(node.key)
            if node.key in needed or planned or self._scheduler.is_awaited(node.key):
                continue
            self._reports.pop(node.key, None)
            if self._scheduler.prune(node.key):
                self._pruned(node, reason)

    # -- the final ranking -------------------------------------------------------------------

    def _choose(self, search: Search, study: OptunaStudy) -> list[Finalist]:
        """The best trials of an ended study, and its baselines, to be run on fresh seeds."""
        final = search.settings.final
        if final is None:
            return []
        seeds = range(FINAL_SEED, FINAL_SEED + final.seeds)
        finalists: list[Finalist] = []
        # The given points are the study's first trials; they can be off the Pareto front.
        given = len(search.settings.points_to_evaluate)
        baselines = (trial for trial in study.complete() if trial.number < given)
        for trial in (*study.ranked(), *baselines):
            values = study.point(trial)
            if any(finalist.values == values for finalist in finalists):
                continue  # the same point twice is one finalist
            if len(finalists) >= final.trials and not (final.baselines and trial.number < given):
                continue
            runs = self._plan_runs(search, study, trial, seeds, phase="final")
            for run in runs:
                self._request(run, None)
            searched = tuple(trial.values)
            finalists.append(
                Finalist(number=trial.number, values=values, searched=searched, runs=runs)
            )
        return finalists

    def _score_finalist(self, settings: SearchSettings, finalist: Finalist) -> bool:
        """Score a finalist; False if it has its scores already, or its runs have not ended."""
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
