"""A study in Optuna's storage: its trials, the drivers that judge them, and their results.

Trials are created beforehand as waiting ones, and a driver claims the lowest by an atomic change
of its state: none is lost or judged twice, whatever the number of drivers. Each driver records
regularly that it is alive; the trials of one that has fallen silent are put back.
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

from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import short
from music_rllib.search import study_record as record
from music_rllib.search.sampler import Proposer, trial_at
from music_rllib.search.storage import studies_of
from music_rllib.search.study_record import Identity, fits
from music_rllib.search.warm_start import warm_start
from music_rllib.store.serialization import content_key

LEASE_SECONDS = 120.0
"""A driver on another machine counts as dead when its last sign of life is older."""
SIGN_SECONDS = 20.0
"""Time between two signs of life."""

DRIVER = "driver:"
"""Beginning of the study attribute with a driver's last sign of life."""


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
        """Open the study, which is made where it is missing.

        Args:
            storage: The storage that it is in.
            base: Name of its search, `sweep/stage`.
            settings: Settings of its search.
            determined_by: Plain data of what else determines its values.
            arm: The compared values that are its own, if there are any.
            alone: No other driver can be at work: running trials were left by a dead one.
        """
        self.settings = settings
        self._storage = storage
        self._arm = dict(arm)
        self.identity = Identity(
            base="/".join((base, *(f"{name}={short(value, name)}" for name, value in arm.items()))),
            fingerprint=content_key([_of_study(settings), {**determined_by, "arm": self._arm}]),
            search=f"{base} @{content_key([_of_study(settings), determined_by])}",
        )
        self._alone = alone
        self._me = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._id = self._find_or_make()
        attributes = self._storage.get_study_user_attrs(self._id)
        self.prior = [
            trial_at(settings.space, data["values"], data["judged"])
            for data in attributes.get(record.PRIOR, [])
        ]
        """Trials of older studies that it learns from."""
        self.learnt = str(attributes.get(record.LEARNT, ""))
        """From which trials of which studies it learns, in words; empty if from none."""
        self._proposer = Proposer(settings, attributes[record.POINTS], self.prior)
        self._signed = 0.0
        self._trials: list[FrozenTrial] | None = None
        self._given: set[int] = set()
        """Numbers of the trials that `claim` has returned."""
        for _ in range(len(self._all_trials()), settings.count):
            self._storage.create_new_trial(self._id, create_trial(state=TrialState.WAITING))
        # Before it claims anything: a driver that opens the study then would take it for dead.
        self._storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", time.time())
        self.release_the_dead()

    # -- making it ---------------------------------------------------------------------------

    def _find_or_make(self) -> int:
        """The study's id in the storage."""
        try:
            study = self._storage.get_study_id_from_name(self.name)
        except KeyError:
            # All but the name must be there before another driver sees the study: prepared first.
            attributes = self._new_attributes()
            directions = [
                StudyDirection.MAXIMIZE if objective.maximised else StudyDirection.MINIMIZE
                for objective in self.settings.objectives
            ]
            try:
                study = self._storage.create_new_study(directions, study_name=self.name)
            except DuplicatedStudyError:
                study = self._storage.get_study_id_from_name(self.name)
            else:
                self._set_attributes(study, attributes)
                return study
        for _ in range(100):
            if record.POINTS in self._storage.get_study_user_attrs(study):
                return study
            time.sleep(0.1)
        # Its maker died in between: nothing has been searched with it yet.
        self._set_attributes(study, self._new_attributes())
        return study

    def _new_attributes(self) -> dict[str, Any]:
        """Attributes of a new study: they hold from then on, whatever becomes of older studies."""
        prior, learnt = warm_start(self._storage, self.settings, self.identity, self._arm)
        return {
            record.FINGERPRINT: self.identity.fingerprint,
            record.BASE: self.identity.base,
            record.SEARCH: self.identity.search,
            record.ARM: self._arm,
            record.SETTINGS: _of_study(self.settings),
            record.PRIOR: prior,
            record.LEARNT: learnt,
            record.POINTS: [*self.settings.points_to_evaluate, *self._earlier_points()],
        }

    def _set_attributes(self, study: int, attributes: Mapping[str, Any]) -> None:
        for key, value in attributes.items():  # the points last: they say that all is there
            self._storage.set_study_user_attr(study, key, value)

    def _earlier_points(self) -> list[dict[str, Any]]:
        """Points of the newest study of the same name with other settings, to be judged first.

        Their runs are in the store, so that a study extended by seeds, or by a finer or wider
        space, pays only for what is new.
        """
        if self.settings.sampler == "grid":
            return []
        older = [
            study._study_id
            for study in studies_of(self._storage)
            if study.user_attrs.get(record.BASE) == self.identity.base
            if study.study_name != self.name
        ]
        if not older:
            return []
        trials = self._storage.get_all_trials(older[-1], deepcopy=False)
        points = [
            trial.user_attrs.get(record.VALUES) for trial in trials if trial.state.is_finished()
        ]
        given = [json.dumps(point, sort_keys=True) for point in self.settings.points_to_evaluate]
        return [
            point
            for point in points
            if point and fits(point, self.settings)
            if json.dumps(point, sort_keys=True) not in given
        ]

    # -- reading it --------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Its name in the storage."""
        return self.identity.name

    def trials(self) -> list[FrozenTrial]:
        """The study's trials in order of their numbers, those beyond `trials` left out.

        As they were at the last `refresh`, or at this driver's last change.
        """
        if self._trials is None:
            trials = sorted(self._all_trials(), key=lambda trial: trial.number)
            self._trials = trials[: self.settings.count]
        return self._trials

    def _all_trials(self) -> list[FrozenTrial]:
        return self._storage.get_all_trials(self._id, deepcopy=False)

    def refresh(self) -> None:
        """Let `trials` read the storage again, where other drivers may have changed it."""
        self._trials = None

    def as_optuna(self) -> optuna.Study:
        """The study as an object of Optuna, for its analyses."""
        return optuna.load_study(study_name=self.name, storage=self._storage)

    # -- judging its trials ------------------------------------------------------------------

    def claim(self) -> FrozenTrial | None:
        """The next trial to judge, with its point; None where there is none, or none yet.

        A trial's point depends on those before it, so it is only claimed when they are far enough.
        """
        trials = self.trials()
        trial = next((trial for trial in trials if self._is_free(trial)), None)
        if trial is None:
            return None
        lag = trial.number - self.settings.concurrent
        judged = trials[: lag + 1] if lag >= 0 else []
        between = trials[len(judged) : trial.number]
        if not all(other.state.is_finished() for other in judged):
            return None
        if not all(record.VALUES in other.user_attrs for other in between):
            return None
        self.refresh()
        if trial.state is TrialState.WAITING:
            if not self._move(trial, TrialState.RUNNING):
                return None  # another driver was faster
            self._set(trial, record.OWNER, self._me)
        if record.VALUES not in trial.user_attrs:
            proposal = self._proposer.propose(trial.number, judged, between)
            for name, distribution in proposal.distributions.items():
                internal = distribution.to_internal_repr(proposal.params[name])
                self._storage.set_trial_param(trial._trial_id, name, internal, distribution)
            for key, attribute in proposal.system_attrs.items():
                self._storage.set_trial_system_attr(trial._trial_id, key, attribute)
            self._set(trial, record.VALUES, proposal.user_attrs[record.VALUES])
        claimed = self._storage.get_trial(trial._trial_id)
        self._given.add(trial.number)
        return claimed

    def _is_free(self, trial: FrozenTrial) -> bool:
        """Whether nobody has it, or this driver claimed it as the database went away."""
        if trial.state is TrialState.RUNNING:
            mine = trial.user_attrs.get(record.OWNER) == self._me
            return mine and trial.number not in self._given
        return trial.state is TrialState.WAITING

    def report(self, trial: FrozenTrial, rung: int, value: float | None, scores: Any) -> None:
        """Keep a trial's scores at a rung, and its value there if it has only one objective."""
        kept = dict(self._storage.get_trial(trial._trial_id).user_attrs.get(record.SCORES, {}))
        with contextlib.suppress(UpdateFinishedTrialError):  # as in `end`
            self._set(trial, record.SCORES, kept | {str(rung): scores})
            if value is not None:
                self._storage.set_trial_intermediate_value(trial._trial_id, rung, value)

    def end(
        self,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
        reason: str,
        *,
        lost: bool = False,
    ) -> None:
        """Keep the end of a trial; if another driver has done so already, theirs stays.

        A trial is `lost` where a run of its failed.
        """
        # Taken over while this driver was silent, and judged already: by the same rules, the same.
        with contextlib.suppress(UpdateFinishedTrialError):
            if reason:
                self._set(trial, record.REASON, reason)
            if lost:
                self._set(trial, record.LOST, True)
            self.refresh()
            self._storage.set_trial_state_values(trial._trial_id, state, values)

    def _set(self, trial: FrozenTrial, key: str, value: Any) -> None:
        self.refresh()
        self._storage.set_trial_user_attr(trial._trial_id, key, value)

    # -- drivers -----------------------------------------------------------------------------

    def sign(self) -> None:
        """Record regularly that this driver is alive, and put the trials of dead ones back."""
        now = time.time()
        if abs(now - self._signed) >= SIGN_SECONDS:  # the clock may be set back
            self._signed = now
            self._storage.set_study_user_attr(self._id, f"{DRIVER}{self._me}", now)
            if not self._alone:
                self.release_the_dead(now)

    def release_the_dead(self, now: float | None = None) -> None:
        """Put the trials of dead drivers back among the waiting ones."""
        now = time.time() if now is None else now
        self.refresh()
        trials = self.trials()
        # Looked at after the trials: whoever had claimed one by then had signed before.
        signs = self._storage.get_study_user_attrs(self._id)
        for trial in trials:
            owner = trial.user_attrs.get(record.OWNER, "")
            if trial.state is not TrialState.RUNNING or owner == self._me:
                continue
            if not owner and not self._alone:
                # Claimed a moment ago: its owner is about to write its name.
                started = trial.datetime_start
                if started is not None and now - started.timestamp() < LEASE_SECONDS:
                    continue
            last = float(signs.get(f"{DRIVER}{owner}", 0.0))
            if self._alone or _is_dead(owner) or now - last > LEASE_SECONDS:
                self._move(trial, TrialState.WAITING)
        self.refresh()

    def release(self) -> None:
        """Put this driver's trials back among the waiting ones."""
        for trial in self.trials():
            if trial.state is TrialState.RUNNING and trial.user_attrs.get(record.OWNER) == self._me:
                self._move(trial, TrialState.WAITING)
        self.refresh()

    def _move(self, trial: FrozenTrial, state: TrialState) -> bool:
        """Give a trial a state; False where another driver was faster, or has ended it."""
        try:
            return self._storage.set_trial_state_values(trial._trial_id, state)
        except UpdateFinishedTrialError:
            return False


def _is_dead(owner: str) -> bool:
    """Whether a driver was a process of this machine, and has ended."""
    host, _, rest = owner.partition(":")
    pid = rest.partition(":")[0]
    return host == socket.gethostname() and pid.isdigit() and not psutil.pid_exists(int(pid))


def _of_study(settings: SearchSettings) -> dict[str, Any]:
    """Settings that determine points and values: not how many trials, nor where they are kept."""
    excluded = {"trials", "final", "study", "storage", "warm_start", "compare", "mode"}
    document = settings.model_dump(mode="json", by_alias=True, exclude=excluded)
    if settings.warm_start is not None:
        document["warm_start"] = settings.warm_start.study
    return document
