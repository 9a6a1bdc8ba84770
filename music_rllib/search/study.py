"""A study in Optuna's storage: which trials there are, who judges which, what came of them.

Trials are laid out beforehand as waiting ones, and a driver claims the lowest by an atomic change
of its state: none is lost or judged twice, whatever the number of drivers. A driver says from time
to time that it is alive; the trials of one that has fallen silent are put back.
"""

from __future__ import annotations

import contextlib
import json
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
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState, create_trial

from music_rllib.config.search.settings import SearchSettings
from music_rllib.experiment.plan import short
from music_rllib.search.sampler import Proposal, Proposer
from music_rllib.search.storage import studies_of
from music_rllib.search.study_record import (
    ARM,
    BASE,
    FINGERPRINT,
    LEARNT,
    OWNER,
    POINTS,
    PRIOR,
    REASON,
    SCORES,
    SEARCH,
    SETTINGS,
    VALUES,
    Identity,
    as_data,
    fits,
    from_data,
)
from music_rllib.search.warm_start import warm_start
from music_rllib.store.files import content_key

__all__ = ["Study"]

LEASE_SECONDS = 120.0
"""After so long without a sign of life a driver on another machine counts as dead."""
SIGN_SECONDS = 20.0

DRIVER = "driver:"


class Study:
    """One study, opened by one driver."""

    def __init__(
        self,
        storage: BaseStorage,
        base: str,
        settings: SearchSettings,
        determined_by: Mapping[str, Any],
        *,
        arm: Mapping[str, Any],
        alone: bool,
    ) -> None:
        """Open or make the study.

        Args:
            storage: Where it is.
            base: Its search's name, `sweep/stage`.
            settings: How it is searched.
            determined_by: What else determines its values, as plain data.
            arm: The compared values that are its own, if there are any.
            alone: No other driver can be at work: whatever is running was left by a dead one.
        """
        self.settings = settings
        self._storage = storage
        self._arm = dict(arm)
        self.identity = Identity(
            base="/".join((base, *(f"{name}={short(value)}" for name, value in arm.items()))),
            fingerprint=content_key([_of_study(settings), {**determined_by, "arm": self._arm}]),
            search=f"{base} @{content_key([_of_study(settings), determined_by])}",
        )
        self._alone = alone
        self._me = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._id, points, prior = self._open()
        self._proposer = Proposer(settings, points, prior)
        self._signed = 0.0
        self._known: list[FrozenTrial] | None = None
        self._given: set[int] = set()
        """Numbers of the trials that `claim` has given out."""
        self.lay_out()
        # Before it claims anything: a driver that opens the study then would take it for dead.
        self._storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", time.time())
        self.release_the_dead()

    # -- making it ---------------------------------------------------------------------------

    def _open(self) -> tuple[int, list[dict[str, Any]], list[FrozenTrial]]:
        try:
            return self._once_made(self._storage.get_study_id_from_name(self.identity.name))
        except KeyError:
            pass  # it is to be made
        directions = [
            StudyDirection.MAXIMIZE if one.maximised else StudyDirection.MINIMIZE
            for one in self.settings.objectives
        ]
        # All but the name must be there before another driver sees the study: prepared first.
        contents = self._contents()
        try:
            study = self._storage.create_new_study(directions, study_name=self.identity.name)
        except DuplicatedStudyError:
            return self._once_made(self._storage.get_study_id_from_name(self.identity.name))
        return self._fill(study, contents)

    def _contents(self) -> dict[str, Any]:
        """What is kept with a new study: from then on it holds, whatever becomes of older ones."""
        prior, learnt = warm_start(self._storage, self.settings, self.identity, self._arm)
        return {
            FINGERPRINT: self.identity.fingerprint,
            BASE: self.identity.base,
            SEARCH: self.identity.search,
            ARM: self._arm,
            SETTINGS: _of_study(self.settings),
            PRIOR: [as_data(trial) for trial in prior],
            LEARNT: learnt,
            POINTS: [*self.settings.points_to_evaluate, *self._taken_over()],
        }

    def _fill(
        self, study: int, contents: Mapping[str, Any]
    ) -> tuple[int, list[dict[str, Any]], list[FrozenTrial]]:
        for key, value in contents.items():  # the points are the last: they say that all is there
            self._storage.set_study_user_attr(study, key, value)
        prior = [from_data(data, self.settings) for data in contents[PRIOR]]
        return study, contents[POINTS], prior

    def _once_made(self, study: int) -> tuple[int, list[dict[str, Any]], list[FrozenTrial]]:
        for _ in range(100):
            attributes = self._storage.get_study_user_attrs(study)
            if POINTS in attributes:
                prior = [from_data(data, self.settings) for data in attributes[PRIOR]]
                return study, attributes[POINTS], prior
            time.sleep(0.1)
        # Its maker died in between: nothing has been searched with it yet.
        return self._fill(study, self._contents())

    def _taken_over(self) -> list[dict[str, Any]]:
        """Points of the newest study of the same name that was judged otherwise: they come first.

        Their runs are in the store, so that a study extended by seeds, or by a finer or wider
        space, pays only for what is new.
        """
        if self.settings.sampler == "grid":
            return []
        older = [
            one
            for one in studies_of(self._storage)
            if one.user_attrs.get(BASE) == self.identity.base
            and one.study_name != self.identity.name
        ]
        if not older:
            return []
        given = [json.dumps(point, sort_keys=True) for point in self.settings.points_to_evaluate]
        points = []
        for trial in self._storage.get_all_trials(older[-1]._study_id, deepcopy=False):
            values = trial.user_attrs.get(VALUES)
            if (
                trial.state.is_finished()
                and values
                and fits(values, self.settings)
                and json.dumps(values, sort_keys=True) not in given
            ):
                points.append(values)
        return points

    def lay_out(self) -> None:
        """Make the trials that aren't there yet, waiting."""
        there = len(self._storage.get_all_trials(self._id, deepcopy=False))
        for _ in range(there, self.settings.count):
            self._storage.create_new_trial(self._id, create_trial(state=TrialState.WAITING))

    # -- looking at it -----------------------------------------------------------------------

    @property
    def name(self) -> str:
        """In the storage."""
        return self.identity.name

    def trials(self) -> list[FrozenTrial]:
        """The study's trials in order of their numbers, those beyond `trials` left out.

        As they were at the last `refresh`, or at this driver's last change.
        """
        if self._known is None:
            found = self._storage.get_all_trials(self._id, deepcopy=False)
            self._known = sorted(found, key=lambda one: one.number)[: self.settings.count]
        return self._known

    def refresh(self) -> None:
        """Look again at what other drivers have done."""
        self._known = None

    @property
    def prior(self) -> int:
        """Trials of an older study that it learns from."""
        return len(self._storage.get_study_user_attrs(self._id).get(PRIOR, []))

    @property
    def learnt(self) -> str:
        """From which trials of which studies it learns, in words; empty if from none."""
        return str(self._storage.get_study_user_attrs(self._id).get(LEARNT, ""))

    # -- working on it -----------------------------------------------------------------------

    def claim(self) -> FrozenTrial | None:
        """The next trial to judge, with its point; None where there is none, or none yet.

        A trial's point depends on those before it, so it is only claimed when they are far enough.
        """
        trials = self.trials()
        trial = next((one for one in trials if self._is_free(one)), None)
        if trial is None:
            return None
        lag = trial.number - self.settings.concurrent
        judged = trials[: lag + 1] if lag >= 0 else []
        between = trials[len(judged) : trial.number]
        if not all(one.state.is_finished() for one in judged):
            return None
        if not all(VALUES in one.user_attrs for one in between):
            return None
        self.refresh()
        if trial.state is TrialState.WAITING:
            if not self._storage.set_trial_state_values(trial._trial_id, TrialState.RUNNING):
                return None  # another driver was faster
            self._set(trial, OWNER, self._me)
        if VALUES not in trial.user_attrs:
            self._keep(trial, self._proposer.propose(trial.number, judged, between))
        found = self._storage.get_trial(trial._trial_id)
        self._given.add(trial.number)
        return found

    def _is_free(self, trial: FrozenTrial) -> bool:
        """Whether nobody has it, or this driver claimed it as the database went away."""
        if trial.state is TrialState.RUNNING:
            mine = trial.user_attrs.get(OWNER) == self._me
            return mine and trial.number not in self._given
        return trial.state is TrialState.WAITING

    def _keep(self, trial: FrozenTrial, proposal: Proposal) -> None:
        for name, distribution in proposal.distributions.items():
            internal = distribution.to_internal_repr(proposal.params[name])
            self._storage.set_trial_param(trial._trial_id, name, internal, distribution)
        for key, value in proposal.system_attrs.items():
            self._storage.set_trial_system_attr(trial._trial_id, key, value)
        self._set(trial, VALUES, dict(proposal.values))

    def report(self, trial: FrozenTrial, rung: int, value: float | None, scores: Any) -> None:
        """Keep what a trial was worth at a rung, if one number says it, and its runs' numbers."""
        kept = dict(self._storage.get_trial(trial._trial_id).user_attrs.get(SCORES, {}))
        with contextlib.suppress(UpdateFinishedTrialError):  # as in `end`
            self._set(trial, SCORES, kept | {str(rung): scores})
            if value is not None:
                self._storage.set_trial_intermediate_value(trial._trial_id, rung, value)

    def end(
        self, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None, reason: str
    ) -> None:
        """Keep what became of a trial; if somebody has done so already, theirs stays."""
        # Taken over while this driver was silent, and judged already: by the same rules, the same.
        with contextlib.suppress(UpdateFinishedTrialError):
            if reason:
                self._set(trial, REASON, reason)
            self.refresh()
            self._storage.set_trial_state_values(trial._trial_id, state, values)

    def _set(self, trial: FrozenTrial, key: str, value: Any) -> None:
        self.refresh()
        self._storage.set_trial_user_attr(trial._trial_id, key, value)

    # -- drivers -----------------------------------------------------------------------------

    def sign(self, now: float | None = None) -> None:
        """Say, from time to time, that this driver is alive, and put back what dead ones hold."""
        now = time.time() if now is None else now
        if abs(now - self._signed) >= SIGN_SECONDS:  # the clock may be set back
            self._signed = now
            self._storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", now)
            if not self._alone:
                self.release_the_dead(now)

    def release_the_dead(self, now: float | None = None) -> None:
        """Put trials of drivers that are no more back among the waiting ones."""
        now = time.time() if now is None else now
        self.refresh()
        trials = self.trials()
        # Looked at after the trials: whoever had claimed one by then had signed before.
        signs = self._storage.get_study_user_attrs(self._id)
        for trial in trials:
            owner = trial.user_attrs.get(OWNER, "")
            if trial.state is not TrialState.RUNNING or owner == self._me:
                continue
            if not owner and not self._alone:
                # Claimed a moment ago: its owner is about to write its name.
                started = trial.datetime_start
                if started is not None and now - started.timestamp() < LEASE_SECONDS:
                    continue
            last = float(signs.get(f"{DRIVER}{owner}", 0.0))
            if self._alone or _is_dead(owner) or now - last > LEASE_SECONDS:
                self._storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
        self.refresh()

    def release(self) -> None:
        """Put what this driver holds back: it stops."""
        for trial in self.trials():
            if trial.state is TrialState.RUNNING and trial.user_attrs.get(OWNER) == self._me:
                self._storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
        self.refresh()

    def as_optuna(self) -> optuna.Study:
        """For Optuna's own analyses."""
        return optuna.load_study(study_name=self.name, storage=self._storage)


def _is_dead(owner: str) -> bool:
    """Whether a driver of this very machine is gone."""
    host, _, rest = owner.partition(":")
    pid = rest.partition(":")[0]
    return host == socket.gethostname() and pid.isdigit() and not psutil.pid_exists(int(pid))


def _of_study(settings: SearchSettings) -> dict[str, Any]:
    """Settings that determine points and values: not how many trials, nor where they are kept."""
    aside = {"trials", "final", "study", "storage", "warm_start", "compare", "mode"}
    found = settings.model_dump(mode="json", by_alias=True, exclude=aside)
    if settings.warm_start is not None:
        found["warm_start"] = settings.warm_start.study
    return found
