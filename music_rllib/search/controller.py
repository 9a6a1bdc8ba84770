"""A sweep's searches as they go: trials become runs, runs become values, the best are run again."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import ConfigError
from music_rllib.config.search.settings import FINAL_SEED, SearchSettings
from music_rllib.experiment.listener import Listener
from music_rllib.experiment.plan import Node, Run
from music_rllib.experiment.scheduler import Status
from music_rllib.experiment.session import Sweep
from music_rllib.redaction import redact
from music_rllib.search.objective import aggregate, prune, score
from music_rllib.search.storage import DATABASE_ERRORS
from music_rllib.search.study_record import SCORES, VALUES
from music_rllib.search.trials import Active, Arm, Finalist, Search, in_words, ranked, up_to
from music_rllib.store.object_folder import DamagedError
from music_rllib.store.run_record import Report

__all__ = ["SearchController"]

POLL_SECONDS = 1.0
"""Between two looks at what other drivers have done."""

Array = NDArray[np.float64]


class SearchController(Listener):
    """Keeps the scheduler filled with what the searches want next, and judges what is finished."""

    def __init__(
        self,
        sweep: Sweep,
        searches: Sequence[Search],
        *,
        reused: Callable[[Node], None] = lambda node: None,
        pruned: Callable[[Node, str], None] = lambda node, reason: None,
        say: Callable[[str], None] = lambda text: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Search in `sweep`.

        Args:
            sweep: Its plan and scheduler grow.
            searches: What to do.
            reused: Told of nodes that are in the store already.
            pruned: Told of nodes that aren't computed any further, and why.
            say: Told in a line what became of a trial.
            now: A clock in seconds.
        """
        self.searches = list(searches)
        self._sweep = sweep
        self._scheduler, self._plan, self._store = sweep.scheduler, sweep.plan, sweep.store
        self._reused, self._pruned, self._say, self._now = reused, pruned, say, now
        self._heard: dict[str, dict[int, Report]] = {}
        self._seen = -1
        self._polled = -POLL_SECONDS
        self._more = True
        self._lost = False
        """Whether the last look at the database failed."""

    # -- listening ---------------------------------------------------------------------------

    def reported(self, node: Node, reports: list[Report]) -> None:
        """Keep what a trial may be judged by before its runs are over."""
        if node.part:
            self._heard.setdefault(node.key, {}).update(
                {report.env_steps: report for report in reports}
            )

    # -- going on ----------------------------------------------------------------------------

    def recall(self) -> None:
        """Put the runs of trials that have ended before this driver began into the plan.

        Those that other drivers have judged since are among them when it is done again.
        """
        for search in self.searches:
            self._recall_trials(search)

    def _recall_trials(self, search: Search) -> None:
        for arm in search.arms:
            for trial in arm.study.trials():
                if trial.state.is_finished() and VALUES in trial.user_attrs:
                    self._recall(search, arm, trial)

    def _recall(self, search: Search, arm: Arm, trial: FrozenTrial) -> None:
        reached = [int(rung) for rung in trial.user_attrs.get(SCORES, {})]
        rung = search.rungs[min(max(reached, default=0), len(search.rungs) - 1)]
        try:
            values = {**arm.values, **trial.user_attrs[VALUES]}
            seeds = self._plan.seeds[: rung.seeds]
            runs = self._runs_of(search, arm, trial, values, seeds)
        except ConfigError:
            return  # that is why it failed
        for run in runs:
            node = self._plan.node(run.key)
            for one in (self._source_of(node), node):
                if one is None or self._scheduler.knows(one.key):
                    continue
                finished = self._store.is_finished(one.key)
                self._scheduler.recall(one, finished=finished)
                if finished:
                    self._reused(one)

    def _runs_of(
        self,
        search: Search,
        arm: Arm,
        trial: FrozenTrial,
        values: Mapping[str, Any],
        seeds: Sequence[int],
        phase: str = "trial",
    ) -> list[Run]:
        """Put a trial into the plan; arms take turns in numbering theirs."""
        number, name = trial.number * len(search.arms) + arm.position, f"{phase}{trial.number}"
        return self._plan.add_trial(search.stage.name, number, values, seeds, name)

    def _source_of(self, node: Node) -> Node | None:
        if node.input is None or node.input.checkpoint is not None:
            return None
        return self._plan.node(node.input.key)

    def advance(self) -> bool:
        """Judge what can be judged and put what is wanted next in the scheduler.

        Returns:
            Whether more may be wanted later.
        """
        now = self._now()
        if self._seen == self._scheduler.changes and now - self._polled < POLL_SECONDS:
            return self._more
        self._polled = now
        try:
            self._go_on()
        except DATABASE_ERRORS as error:
            # What was begun is begun again next time; runs go on meanwhile.
            if not self._lost:
                cause = str(error.__cause__ or error).strip().splitlines()[0]
                self._say(f"the study's database does not answer, trying again: {redact(cause)}")
            self._lost = True
            return True
        self._lost = False
        self._seen = self._scheduler.changes
        self._more = not self.over
        return self._more

    def _go_on(self) -> None:
        for search in self.searches:
            for arm in search.arms:
                arm.study.refresh()
        while True:
            before = self._scheduler.changes
            moved = [self._advance(search) for search in self.searches]
            if not any(moved) and before == self._scheduler.changes:
                break

    @property
    def over(self) -> bool:
        """Whether every search has its ranking, or can't have one."""
        return all(
            arm.finalists is not None
            and all(one.scores is not None or one.failure for one in arm.finalists)
            for search in self.searches
            for arm in search.arms
        )

    def stop(self) -> None:
        """This driver ends: let others, or a later one, have its trials, and know of theirs."""
        for search in self.searches:
            for arm in search.arms:
                with contextlib.suppress(*DATABASE_ERRORS):  # they are taken over in any case
                    arm.study.release()
        with contextlib.suppress(*DATABASE_ERRORS):  # the plan lacks what others have judged
            self.recall()

    def _advance(self, search: Search) -> bool:
        moved = False
        for arm in search.arms:
            arm.study.sign()
            for active in list(arm.active.values()):
                moved |= self._judge(search, arm, active)
            # Only what this driver has room for: the rest is for others.
            while self._scheduler.next_ready() is None:
                trial = arm.study.claim()
                if trial is None:
                    break
                moved = True
                self._begin(search, arm, trial)
        if all(arm.finalists is None and arm.over for arm in search.arms):
            self._recall_trials(search)
            for arm in search.arms:
                arm.finalists = self._choose(search, arm)
            moved = True
        for arm in search.arms:
            for finalist in arm.finalists or ():
                moved |= self._read_final(search, finalist)
        return moved

    # -- trials ------------------------------------------------------------------------------

    def _begin(self, search: Search, arm: Arm, trial: FrozenTrial) -> None:
        values = {**arm.values, **trial.user_attrs[VALUES]}
        active = Active(trial=trial, values=values)
        arm.active[trial.number] = active
        self._climb(search, arm, active)

    def _climb(self, search: Search, arm: Arm, active: Active) -> None:
        """Ask for what the trial's rung takes."""
        rung = search.rungs[active.rung]
        seeds = self._plan.seeds[: rung.seeds]
        try:
            active.runs = self._runs_of(search, arm, active.trial, active.values, seeds)
        except ConfigError as error:
            self._end(search, arm, active, TrialState.FAIL, None, "; ".join(error.lines))
            return
        for run in active.runs:
            self._want(run, rung.env_steps)

    def _want(self, run: Run, until: int | None) -> None:
        node = self._plan.node(run.key)
        if (source := self._source_of(node)) is not None:
            self._want_node(source, None)
        self._want_node(node, until if until is None or until < node.run.env_steps else None)

    def _want_node(self, node: Node, until: int | None) -> None:
        new = not self._scheduler.knows(node.key)
        # One that is damaged is handed out: the worker that finds it there says what is wrong.
        finished = new and self._store.is_sound(node.key)
        self._scheduler.want(node, until, finished=finished)
        if finished:
            self._reused(node)

    def _judge(self, search: Search, arm: Arm, active: Active) -> bool:
        """Whether all that the rung takes is there, and so something came of it."""
        states = {run.key: self._scheduler[run.key] for run in active.runs}
        lost = [run for run in active.runs if states[run.key] in _LOST]
        if lost:
            why = f"{lost[0].label} {states[lost[0].key]}"
            self._end(search, arm, active, TrialState.FAIL, None, why)
            return True
        if not all(state in _THERE for state in states.values()):
            return False
        rung = search.rungs[active.rung]
        try:
            scores = self._scores(search.settings, active.runs, rung.env_steps)
        except (ValueError, DamagedError) as error:
            self._end(search, arm, active, TrialState.FAIL, None, str(error))
            return True
        values = [
            aggregate(objective, of_objective)
            for objective, of_objective in zip(search.settings.objectives, scores, strict=True)
        ]
        last = active.rung == len(search.rungs) - 1
        kept = [of_objective.tolist() for of_objective in scores]
        arm.study.report(active.trial, active.rung, values[0] if len(values) == 1 else None, kept)
        if last:
            self._end(search, arm, active, TrialState.COMPLETE, values, "")
            return True
        if (reason := self._stops(search, arm, active, scores[0])) is not None:
            self._end(search, arm, active, TrialState.PRUNED, None, reason)
            return True
        active.rung += 1
        self._climb(search, arm, active)
        return True

    def _scores(
        self, settings: SearchSettings, runs: Sequence[Run], until: int | None
    ) -> list[Array]:
        """For each objective `[seeds, tasks]`; `runs` has those of a seed together.

        Raises:
            ValueError: A run has no number for an objective.
        """
        tasks = len({run.task for run in runs})
        found: list[list[float]] = [[] for _ in settings.objectives]
        for run in runs:
            node = self._plan.node(run.key)
            history = up_to(self._history(run.key), until)
            for objective, numbers in zip(settings.objectives, found, strict=True):
                try:
                    numbers.append(score(objective, history, until or node.run.env_steps))
                except ValueError as error:
                    raise ValueError(f"{run.label}: {error}") from error
        return [np.asarray(numbers).reshape(-1, tasks) for numbers in found]

    def _history(self, key: str) -> list[Report]:
        if self._scheduler[key] in _FINISHED:
            return self._store.history(key)
        return [report for _, report in sorted(self._heard.get(key, {}).items())]

    def _stops(self, search: Search, arm: Arm, active: Active, mine: Array) -> str | None:
        """Why the trial is stopped at its rung; None: it goes on.

        It is compared with the trials that had all ended when it was chosen, so that the answer
        doesn't depend on who was faster.
        """
        pruning = search.settings.pruning
        assert pruning is not None
        number = active.trial.number
        if number < pruning.warm_up:
            return None
        earlier = arm.study.trials()[: max(0, number - search.settings.concurrent + 1)]
        at, end = str(active.rung), str(len(search.rungs) - 1)
        kept = {other.number: other.user_attrs.get(SCORES, {}) for other in earlier}
        others = {n: np.asarray(scores[at][0]) for n, scores in kept.items() if at in scores}
        whole = {n: np.asarray(scores[end][0]) for n, scores in kept.items() if end in scores}
        rung = search.rungs[active.rung]
        steps = "" if rung.env_steps is None else f" after {rung.env_steps:,} env steps"
        verdict = prune(
            search.settings.objectives[0],
            pruning,
            scores=mine,
            others=others,
            whole=whole,
            place=f"with {mine.shape[0]} of {len(self._plan.seeds)} seeds{steps}",
        )
        return verdict.reason if verdict.stop else None

    def _end(
        self,
        search: Search,
        arm: Arm,
        active: Active,
        state: TrialState,
        values: list[float] | None,
        reason: str,
    ) -> None:
        arm.study.end(active.trial, state, values, reason)
        del arm.active[active.trial.number]
        name = f"{search.stage.name} {in_words(arm.values)}trial {active.trial.number}"
        if state is TrialState.COMPLETE:
            self._say(f"{name}: {', '.join(f'{value:.4g}' for value in values or ())}")
        else:
            self._say(
                f"{name}: {'stopped early' if state is TrialState.PRUNED else 'FAILED'}, {reason}"
            )
        wanted = {
            run.key for arm in search.arms for other in arm.active.values() for run in other.runs
        }
        for run in active.runs:
            if run.key in wanted:
                continue
            self._heard.pop(run.key, None)
            if self._scheduler.withdraw(run.key):
                self._pruned(self._plan.node(run.key), reason)

    # -- the final ranking -------------------------------------------------------------------

    def _choose(self, search: Search, arm: Arm) -> list[Finalist]:
        """The best trials of a finished study, and its baselines, to be run on fresh seeds."""
        final = search.settings.final
        if final is None:
            return []
        seeds = [FINAL_SEED + position for position in range(final.seeds)]
        finalists: list[Finalist] = []
        seen: list[Mapping[str, Any]] = []
        for trial in ranked(search.settings, arm.study.trials()):
            values = {**arm.values, **trial.user_attrs[VALUES]}
            if values in seen:
                continue  # the same point twice is one finalist
            # The given points are the study's first trials.
            baseline = final.baselines and trial.number < len(search.settings.points_to_evaluate)
            if len(finalists) >= final.trials and not baseline:
                continue
            seen.append(values)
            runs = self._runs_of(search, arm, trial, values, seeds, phase="final")
            for run in runs:
                self._want(run, None)
            searched = tuple(trial.values or ())
            finalists.append(
                Finalist(number=trial.number, values=values, searched=searched, runs=runs)
            )
        return finalists

    def _read_final(self, search: Search, finalist: Finalist) -> bool:
        if finalist.scores is not None or finalist.failure:
            return False
        states = [self._scheduler[run.key] for run in finalist.runs]
        if any(state in _LOST for state in states):
            finalist.failure = "a run on fresh seeds failed"
        elif all(state in _FINISHED for state in states):
            try:
                finalist.scores = self._scores(search.settings, finalist.runs, None)
            except (ValueError, DamagedError) as error:
                finalist.failure = str(error)
        return finalist.scores is not None or bool(finalist.failure)


_FINISHED = (Status.FINISHED, Status.REUSED)
_THERE = (*_FINISHED, Status.PAUSED)
_LOST = (Status.FAILED, Status.SKIPPED)
