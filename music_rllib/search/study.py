"""A study in Optuna's storage: its trials, the drivers that run them, and their results.

Trials are created in advance as waiting ones. A driver claims the lowest one by an atomic change
of its state, so no trial is lost or run twice, whatever the number of drivers. Each driver records
a heartbeat; the trials of a driver without one return to the waiting ones.

The name of a study holds a hash of everything that determines its points and values: changed
settings make another study, which first evaluates the points of the earlier one again. Their runs
are in the store, so only new runs are trained.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import optuna
import psutil
from optuna.exceptions import DuplicatedStudyError, UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState, create_trial

from music_rllib.config.problems import same
from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import short
from music_rllib.search.sampler import VALUES, Proposer, directions_of
from music_rllib.store.serialization import content_key

POINTS = "music_rllib:points"
"""Attribute of a study: the points of its first trials, which stay if older studies change."""

CREATION_SECONDS = 10.0
"""Longest wait for another driver that creates the study."""
# Attributes of a trial, in addition to its point.
OWNER, REASON, SCORES = "owner", "reason", "scores"
LOST = "lost"
"""The trial failed because one of its runs failed."""

LEASE_SECONDS = 120.0
"""A driver on another machine counts as dead when its last heartbeat is older."""
HEARTBEAT_SECONDS = 20.0
"""Time between two heartbeats."""
DRIVER = "driver:"
"""Beginning of the study attribute with a driver's last heartbeat."""


class OptunaStudy:
    """The study of a search, or of one compared value; opened by one driver."""

    def __init__(
        self,
        storage: BaseStorage,
        base: str,
        settings: SearchSettings,
        determined_by: Mapping[str, Any],
        *,
        compared: Mapping[str, Any],
        alone: bool,
    ) -> None:
        """Open the study, which is created if it does not exist.

        Args:
            storage: The studies' storage.
            base: Beginning of the names of the search's studies, `sweep/stage`.
            settings: Settings of the search.
            determined_by: Plain data of everything else that determines the study's values.
            compared: The compared values of the study; empty in `search` mode.
            alone: Whether no other driver is running now: running trials belong to a dead one.
        """
        self.settings = settings
        self.compared = dict(compared)
        self._storage = storage
        self._me = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._id, self.name = self._find_or_create(base, determined_by)
        attributes = storage.get_study_user_attrs(self._id)
        self._proposer = Proposer(settings, attributes[POINTS])
        self._last_heartbeat = 0.0
        self._trials: list[FrozenTrial] | None = None
        self._begun: set[int] = set()
        """Numbers of the trials that `claim` has begun to claim."""
        self._claimed: set[int] = set()
        """Numbers of the trials that `claim` has returned."""
        for _ in range(len(self._all_trials()), settings.count):
            storage.create_new_trial(self._id, create_trial(state=TrialState.WAITING))
        # Before it claims a trial, so that no other driver takes it for dead.
        storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", time.time())
        self._seen: dict[str, tuple[float, float]] = {}
        """Last heartbeat of each other driver, and the monotonic time when it was first seen."""
        self.release_the_dead(alone=alone)

    def _find_or_create(self, base: str, determined_by: Mapping[str, Any]) -> tuple[int, str]:
        """The id and the name of the study."""
        storage, settings = self._storage, self.settings
        # Neither the number of trials nor the storage determines points and values.
        excluded = {"trials", "final", "study", "storage", "compare", "mode"}
        own = settings.model_dump(mode="json", by_alias=True, exclude=excluded)
        values = (f"{name}={short(value, name)}" for name, value in self.compared.items())
        base = "/".join((base, *values))
        name = f"{base} @{content_key([own, {**determined_by, 'arm': self.compared}])}"

        try:
            study = storage.get_study_id_from_name(name)
        except KeyError:
            points = _first_points(storage, settings, base)  # before another driver sees the study
            try:
                study = storage.create_new_study(directions_of(settings), study_name=name)
            except DuplicatedStudyError:
                study = storage.get_study_id_from_name(name)
            else:
                storage.set_study_user_attr(study, POINTS, points)
                return study, name
        patience = time.monotonic() + CREATION_SECONDS
        while POINTS not in storage.get_study_user_attrs(study):
            if time.monotonic() > patience:  # its creator died before any search used it
                points = _first_points(storage, settings, base)
                storage.set_study_user_attr(study, POINTS, points)
            time.sleep(0.1)
        return study, name

    # -- reading -----------------------------------------------------------------------------

    def trials(self) -> list[FrozenTrial]:
        """The first `settings.count` trials in order of their numbers.

        As they were at the last `refresh`, or at this driver's last change.
        """
        if self._trials is None:
            trials = sorted(self._all_trials(), key=lambda trial: trial.number)
            self._trials = trials[: self.settings.count]
        return self._trials

    def _all_trials(self) -> list[FrozenTrial]:
        return self._storage.get_all_trials(self._id, deepcopy=False)

    def refresh(self) -> None:
        """Let `trials` read the storage again, because other drivers may have changed it."""
        self._trials = None

    @property
    def has_ended(self) -> bool:
        """Whether every trial has ended, in any driver."""
        return all(trial.state.is_finished() for trial in self.trials())

    def point(self, trial: FrozenTrial) -> dict[str, Any]:
        """A trial's point, with the compared values."""
        return {**self.compared, **trial.user_attrs[VALUES]}

    def complete(self) -> list[FrozenTrial]:
        return [trial for trial in self.trials() if trial.state is TrialState.COMPLETE]

    def ranked(self) -> list[FrozenTrial]:
        """Complete trials, the best first; of several objectives, only the Pareto front."""
        complete = self.complete()
        signs = [1.0 if objective.maximised else -1.0 for objective in self.settings.objectives]

        def goodness(trial: FrozenTrial) -> tuple[float, ...]:
            return tuple(sign * value for sign, value in zip(signs, trial.values, strict=True))

        if len(signs) > 1:
            front = optuna.create_study(directions=directions_of(self.settings))
            front.add_trials(complete)
            best = {trial.number for trial in front.best_trials}
            complete = [trial for number, trial in enumerate(complete) if number in best]
        return sorted(complete, key=lambda t: (*(-part for part in goodness(t)), t.number))

    def as_optuna(self) -> optuna.Study:
        """The study as an object of Optuna, for its analyses."""
        return optuna.load_study(study_name=self.name, storage=self._storage)

    # -- trials ------------------------------------------------------------------------------

    def claim(self) -> FrozenTrial | None:
        """The next trial to run, with its point; None if there is none, or not yet.

        A trial's point depends on earlier trials, so it can only be claimed after these.
        """
        trials = self.trials()
        trial = next((trial for trial in trials if self._is_free(trial)), None)
        if trial is None:
            return None
        lag = trial.number - self.settings.concurrent
        ended = trials[: lag + 1] if lag >= 0 else []
        running = trials[len(ended) : trial.number]
        if not all(other.state.is_finished() for other in ended):
            return None
        if not all(VALUES in other.user_attrs for other in running):
            return None
        self.refresh()
        if trial.state is TrialState.WAITING:
            self._begun.add(trial.number)
            if not self._move(trial, TrialState.RUNNING):
                self._begun.discard(trial.number)
                return None  # another driver was faster
        if trial.user_attrs.get(OWNER) != self._me:
            self._set(trial, OWNER, self._me)
        if VALUES not in trial.user_attrs:
            proposal = self._proposer.propose(trial.number, ended, running)
            for name, distribution in proposal.distributions.items():
                internal = distribution.to_internal_repr(proposal.params[name])
                self._storage.set_trial_param(trial._trial_id, name, internal, distribution)
            for key, attribute in proposal.system_attrs.items():
                self._storage.set_trial_system_attr(trial._trial_id, key, attribute)
            self._set(trial, VALUES, proposal.user_attrs[VALUES])
        claimed = self._storage.get_trial(trial._trial_id)
        self._claimed.add(trial.number)
        return claimed

    def _is_free(self, trial: FrozenTrial) -> bool:
        """Whether no driver has it, or this driver lost the database while it claimed it."""
        if trial.state is TrialState.RUNNING:
            owner = trial.user_attrs.get(OWNER)
            mine = owner == self._me or (owner is None and trial.number in self._begun)
            return mine and trial.number not in self._claimed
        return trial.state is TrialState.WAITING

    def report(self, trial: FrozenTrial, rung: int, value: float | None, scores: Any) -> None:
        """Keep a trial's scores at a rung, and its value if it has only one objective."""
        kept = dict(self._storage.get_trial(trial._trial_id).user_attrs.get(SCORES, {}))
        with contextlib.suppress(UpdateFinishedTrialError):  # as in `end`
            self._set(trial, SCORES, kept | {str(rung): scores})
            if value is not None:
                self._storage.set_trial_intermediate_value(trial._trial_id, rung, value)

    def end(
        self,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None = None,
        reason: str = "",
        *,
        lost: bool = False,
    ) -> None:
        """Keep the end of a trial, unless another driver has ended it.

        A trial is `lost` if one of its runs failed.
        """
        # Another driver took it over while this one had no heartbeat, and has the same result.
        with contextlib.suppress(UpdateFinishedTrialError):
            if reason:
                self._set(trial, REASON, reason)
            if lost:
                self._set(trial, LOST, True)
            self.refresh()
            self._storage.set_trial_state_values(trial._trial_id, state, values)

    def _set(self, trial: FrozenTrial, key: str, value: Any) -> None:
        self.refresh()
        self._storage.set_trial_user_attr(trial._trial_id, key, value)

    # -- drivers -----------------------------------------------------------------------------

    def heartbeat(self) -> None:
        """Regularly record that this driver is alive, and release the trials of dead drivers."""
        now = time.time()
        if abs(now - self._last_heartbeat) >= HEARTBEAT_SECONDS:  # the clock may be set back
            self._last_heartbeat = now
            self._storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", now)
            self.release_the_dead()

    def release_the_dead(self, *, alone: bool = False) -> None:
        """Return the trials of dead drivers to the waiting ones; `alone`: of all other drivers."""
        self.refresh()
        trials = self.trials()
        # Read after the trials: the owner of a claimed trial had recorded a heartbeat before.
        heartbeats = self._storage.get_study_user_attrs(self._id)
        for trial in trials:
            owner = trial.user_attrs.get(OWNER, "")
            if trial.state is not TrialState.RUNNING or owner == self._me:
                continue
            last = float(heartbeats.get(f"{DRIVER}{owner}", 0.0))
            if not owner and trial.datetime_start is not None:
                # Claimed a moment ago: its owner is about to write its name.
                last, owner = trial.datetime_start.timestamp(), f"trial {trial.number}"
            if alone or self._is_dead(owner, last):
                self._move(trial, TrialState.WAITING)
        self.refresh()

    def _is_dead(self, owner: str, heartbeat: float) -> bool:
        """Whether a driver is a process of this machine that has ended, or shows no life.

        Its heartbeat is old, or was dated ahead by a fast clock and does not change.
        """
        if self._seen.get(owner, (None,))[0] != heartbeat:
            self._seen[owner] = (heartbeat, time.monotonic())
        unchanged = time.monotonic() - self._seen[owner][1]
        return _has_ended(owner) or max(time.time() - heartbeat, unchanged) > LEASE_SECONDS

    def release(self) -> None:
        """Return this driver's trials to the waiting ones."""
        for trial in self.trials():
            if trial.state is TrialState.RUNNING and trial.user_attrs.get(OWNER) == self._me:
                self._move(trial, TrialState.WAITING)
        self.refresh()

    def _move(self, trial: FrozenTrial, state: TrialState) -> bool:
        """Change a trial's state; False if another driver was faster, or has ended it."""
        try:
            return self._storage.set_trial_state_values(trial._trial_id, state)
        except UpdateFinishedTrialError:
            return False


def _has_ended(owner: str) -> bool:
    """Whether a driver was a process of this machine, and has ended."""
    host, _, rest = owner.partition(":")
    pid = rest.partition(":")[0]
    return host == socket.gethostname() and pid.isdigit() and not psutil.pid_exists(int(pid))


# Creating a study --------------------------------------------------------------------------------


def fits(values: Mapping[str, Any], settings: SearchSettings) -> bool:
    """Whether a point is in the space."""
    seen: dict[str, Any] = {}
    for name, dimension in settings.space.items():
        exists = dimension.applies(seen)
        if exists != (name in values) or (exists and not dimension.contains(values[name])):
            return False
        if exists:
            seen[name] = values[name]
    return len(seen) == len(values)


def _first_points(
    storage: BaseStorage, settings: SearchSettings, base: str
) -> list[dict[str, Any]]:
    """The given points, and those of the newest study with the same base and other settings."""
    given = list(settings.points_to_evaluate)
    older = [
        study._study_id
        for study in storage.get_all_studies()
        if study.study_name.rpartition(" @")[0] == base and POINTS in study.user_attrs
    ]
    if settings.sampler == "grid" or not older:
        return given
    trials = storage.get_all_trials(max(older), deepcopy=False)
    # The sampler chose the rest of a point that is given in part: it keeps these values.
    chosen = [values for trial in trials[: len(given)] if (values := trial.user_attrs.get(VALUES))]
    chosen = [v for v in chosen if fits(v, settings) and not any(same(v, one) for one in given)]
    for at, point in enumerate(given):
        whole = (v for v in chosen if all(k in v and same(v[k], point[k]) for k in point))
        if not fits(point, settings) and (values := next(whole, None)) is not None:
            given[at] = values
            chosen.remove(values)
    # It may have been stopped before it evaluated the points that it took over itself.
    earlier = list(storage.get_study_user_attrs(max(older))[POINTS])
    earlier += [trial.user_attrs.get(VALUES) for trial in trials if trial.state.is_finished()]
    for point in earlier:
        if point and fits(point, settings) and not any(same(point, one) for one in given):
            given.append(point)
    return given
