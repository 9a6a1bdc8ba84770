"""The trials of older studies that a new study learns from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import same
from music_rllib.config.search import SearchSettings, WarmStart
from music_rllib.redaction import redact
from music_rllib.search.storage import open_studies, studies_of
from music_rllib.search.study_record import ARM, SEARCH, VALUES, Identity, fits
from music_rllib.store.storage import StorageError


def no_study_error(warm: WarmStart, known: Sequence[str]) -> StorageError:
    """The error that none of the `known` studies is the one to learn from."""
    if known:
        rule = f"must be (the beginning of) one of {', '.join(known)}, got {warm.study!r}"
    else:
        place = "the search's own storage" if warm.storage is None else redact(warm.storage)
        rule = (
            f"must be (the beginning of) a study's name, got {warm.study!r}: there are no other "
            f"studies in {place}"
        )
    return StorageError(f"search.warm_start.study {rule}")


def warm_start(
    storage: BaseStorage, settings: SearchSettings, identity: Identity, arm: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], str]:
    """The trials of older studies that lie in the space, and a description of them in words.

    Returns:
        A trial has its point, `values`, and its objective values, `judged`.

    Raises:
        StorageError: There are none.
    """
    warm = settings.warm_start
    if warm is None:
        return [], ""
    if warm.storage is not None:
        storage = open_studies(warm.storage, warm_start=True)
    older = _older(storage, warm, identity)
    prior, ended = [], 0
    for study in older:
        for trial in storage.get_all_trials(study._study_id, deepcopy=False):
            ended += trial.state.is_finished()
            values = _translated(study, trial, settings, arm)
            if values is not None:
                prior.append({"values": values, "judged": list(trial.values)})
    names = ", ".join(study.study_name for study in older)
    if not prior:
        raise StorageError(
            f"search.warm_start.study must have judged trials that {identity.base} can "
            f"learn from, got {names}, none of whose {ended} trials has the same objectives "
            "and lies in the space"
        )
    return prior, f"learnt from {len(prior)} of {ended} trials of {names}"


def _older(storage: BaseStorage, warm: WarmStart, identity: Identity) -> list[Any]:
    """The studies of the newest search whose names begin with the wanted one."""
    others = [
        study for study in studies_of(storage) if study.user_attrs.get(SEARCH) != identity.search
    ]
    matching = [study for study in others if study.study_name.startswith(warm.study)]
    if matching:
        newest = _search_of(matching[-1])
        return [study for study in matching if _search_of(study) == newest]
    raise no_study_error(warm, [study.study_name for study in others])


def _search_of(study: Any) -> str:
    """Name that all studies of a search share; a study without it is a search of its own."""
    return str(study.user_attrs.get(SEARCH, study.study_name))


def _translated(
    study: Any, trial: FrozenTrial, settings: SearchSettings, arm: Mapping[str, Any]
) -> dict[str, Any] | None:
    """The point of another study's trial as one of this study's; None if it can't be one."""
    maximised = [direction is StudyDirection.MAXIMIZE for direction in study.directions]
    if trial.state is not TrialState.COMPLETE or trial.values is None:
        return None
    if maximised != [objective.maximised for objective in settings.objectives]:
        return None
    values = study.user_attrs.get(ARM, {}) | trial.user_attrs.get(VALUES, dict(trial.params))
    for name, value in arm.items():
        if name in values and not same(values.pop(name), value):
            return None  # it has another compared value
    return values if fits(values, settings) else None
