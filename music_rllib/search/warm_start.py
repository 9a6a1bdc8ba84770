"""What a new study learns from older ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import same
from music_rllib.config.search.settings import SearchSettings, WarmStart
from music_rllib.redaction import redact
from music_rllib.search.storage import open_older, studies_of
from music_rllib.search.study_record import ARM, SEARCH, VALUES, Identity, fits, from_data
from music_rllib.store.object_folder import StorageError

__all__ = ["no_study_error", "warm_start"]


def no_study_error(warm: WarmStart, known: Sequence[str]) -> StorageError:
    """That none of the `known` studies is the one to learn from."""
    if known:
        rule = f"must be (the beginning of) one of {', '.join(known)}, got {warm.study!r}"
    else:
        place = "the search's own storage" if warm.storage is None else redact(warm.storage)
        rule = (
            f"must be (the beginning of) a study's name, got {warm.study!r}: there are no other "
            f"studies in {place}"
        )
    return StorageError(f"search.warm_start.study {rule}")


def search_of(study: Any) -> str:
    """What the studies of one search have in common; its own name for one that doesn't say."""
    return str(study.user_attrs.get(SEARCH, study.study_name))


def warm_start(
    storage: BaseStorage, settings: SearchSettings, identity: Identity, arm: Mapping[str, Any]
) -> tuple[list[FrozenTrial], str]:
    """Trials of older studies to learn from, as far as they fit, and in words which they are.

    Raises:
        StorageError: There are none.
    """
    warm = settings.warm_start
    if warm is None:
        return [], ""
    place = storage if warm.storage is None else open_older(warm.storage)
    older = _older(place, warm, identity)
    prior, ended = [], 0
    for study in older:
        for trial in place.get_all_trials(study._study_id, deepcopy=False):
            ended += trial.state.is_finished()
            values = _as_mine(study, trial, settings, arm)
            if values is not None:
                data = {"values": values, "judged": list(trial.values)}
                prior.append(from_data(data, settings))
    names = ", ".join(study.study_name for study in older)
    if not prior:
        raise StorageError(
            f"search.warm_start.study must have judged trials that {identity.base} can "
            f"learn from, got {names}, none of whose {ended} trials has the same objectives "
            "and lies in the space"
        )
    return prior, f"learnt from {len(prior)} of {ended} trials of {names}"


def _older(storage: BaseStorage, warm: WarmStart, identity: Identity) -> list[Any]:
    """Studies of the newest search whose names begin as is wished: one, or compared ones."""
    others = [one for one in studies_of(storage) if one.user_attrs.get(SEARCH) != identity.search]
    found = [one for one in others if one.study_name.startswith(warm.study)]
    if found:
        newest = search_of(found[-1])
        return [one for one in found if search_of(one) == newest]
    raise no_study_error(warm, [one.study_name for one in others])


def _as_mine(
    study: Any, trial: FrozenTrial, settings: SearchSettings, arm: Mapping[str, Any]
) -> dict[str, Any] | None:
    """The point of another study's trial as one of this study's; None if it can't be one."""
    objectives = settings.objectives
    maximised = [one is StudyDirection.MAXIMIZE for one in study.directions]
    if trial.state is not TrialState.COMPLETE or trial.values is None:
        return None
    if maximised != [one.maximised for one in objectives]:
        return None
    values = study.user_attrs.get(ARM, {}) | trial.user_attrs.get(VALUES, dict(trial.params))
    for name, value in arm.items():
        if name in values and not same(values.pop(name), value):
            return None  # it tells of another compared value
    return values if fits(values, settings) else None
