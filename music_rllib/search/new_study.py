"""Creates studies in Optuna's storage, with the trials and points that they start from.

The name of a study holds a hash of everything that determines its points and values: changed
settings make another study, which first evaluates the points of the earlier one again. Their runs
are in the store, so only new runs are trained.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

from optuna.exceptions import DuplicatedStudyError
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from music_rllib.config.problems import same
from music_rllib.config.search import SearchSettings, WarmStart
from music_rllib.experiment.plan import short
from music_rllib.redaction import redact
from music_rllib.search.sampler import VALUES, directions_of
from music_rllib.search.storage import open_studies, studies_of
from music_rllib.store.serialization import content_key
from music_rllib.store.storage import StorageError

# Attributes of a study.
FINGERPRINT, SETTINGS = "music_rllib:fingerprint", "music_rllib:settings"
BASE, SEARCH, COMPARED = "music_rllib:base", "music_rllib:search", "music_rllib:arm"
POINTS = "music_rllib:points"
"""Points of the first trials; it is set last, when all other attributes are there."""
WARM_START, WARM_START_TEXT = "music_rllib:prior", "music_rllib:learnt"
"""The trials of a warm start, and the studies that they come from in words."""

CREATION_SECONDS = 10.0
"""Longest wait for another driver that creates the study."""


def find_or_create(
    storage: BaseStorage,
    base: str,
    settings: SearchSettings,
    determined_by: Mapping[str, Any],
    compared: Mapping[str, Any],
) -> tuple[int, str]:
    """The id and the name of a study, which is created if it does not exist.

    Args:
        storage: The studies' storage.
        base: Beginning of the names of the search's studies, `sweep/stage`.
        settings: Settings of the search.
        determined_by: Plain data of everything else that determines the study's values.
        compared: The compared values of the study; empty in `search` mode.

    Raises:
        StorageError: The study must have a warm start, and there are no trials for it.
    """
    own = _own_settings(settings)
    search = f"{base} @{content_key([own, determined_by])}"
    base = "/".join((base, *(f"{name}={short(value, name)}" for name, value in compared.items())))
    fingerprint = content_key([own, {**determined_by, "arm": dict(compared)}])
    name = f"{base} @{fingerprint}"

    def attributes() -> dict[str, Any]:
        """Attributes of a new study, which stay the same if older studies change."""
        trials, text = _warm_start(storage, settings, base, search, compared)
        earlier = _earlier_points(storage, settings, base, name)
        return {
            FINGERPRINT: fingerprint,
            BASE: base,
            SEARCH: search,
            COMPARED: dict(compared),
            SETTINGS: own,
            WARM_START: trials,
            WARM_START_TEXT: text,
            POINTS: [*settings.points_to_evaluate, *earlier],
        }

    try:
        study = storage.get_study_id_from_name(name)
    except KeyError:
        found = attributes()  # before another driver sees the study
        try:
            study = storage.create_new_study(directions_of(settings), study_name=name)
        except DuplicatedStudyError:
            study = storage.get_study_id_from_name(name)
        else:
            _set_attributes(storage, study, found)
            return study, name
    patience = time.monotonic() + CREATION_SECONDS
    while POINTS not in storage.get_study_user_attrs(study):
        if time.monotonic() > patience:  # its creator died before any search used it
            _set_attributes(storage, study, attributes())
        time.sleep(0.1)
    return study, name


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


def no_study_error(warm: WarmStart, known: Sequence[str]) -> StorageError:
    """The error that the study of a warm start is none of the `known` ones."""
    if known:
        rule = f"must be (the beginning of) one of {', '.join(known)}, got {warm.study!r}"
    else:
        place = "the search's own storage" if warm.storage is None else redact(warm.storage)
        rule = (
            f"must be (the beginning of) a study's name, got {warm.study!r}: there are no other "
            f"studies in {place}"
        )
    return StorageError(f"search.warm_start.study {rule}")


def _own_settings(settings: SearchSettings) -> dict[str, Any]:
    """The settings that determine points and values: neither number of trials nor storage."""
    excluded = {"trials", "final", "study", "storage", "warm_start", "compare", "mode"}
    document = settings.model_dump(mode="json", by_alias=True, exclude=excluded)
    if settings.warm_start is not None:
        document["warm_start"] = settings.warm_start.study
    return document


def _set_attributes(storage: BaseStorage, study: int, attributes: Mapping[str, Any]) -> None:
    for key, value in attributes.items():
        storage.set_study_user_attr(study, key, value)


def _earlier_points(
    storage: BaseStorage, settings: SearchSettings, base: str, name: str
) -> list[dict[str, Any]]:
    """Points of the newest study with the same base and other settings that are in the space."""
    older = [
        study._study_id
        for study in studies_of(storage)
        if study.user_attrs.get(BASE) == base and study.study_name != name
    ]
    if settings.sampler == "grid" or not older:
        return []
    given = [json.dumps(point, sort_keys=True) for point in settings.points_to_evaluate]
    trials = storage.get_all_trials(older[-1], deepcopy=False)
    points = [trial.user_attrs.get(VALUES) for trial in trials if trial.state.is_finished()]
    return [
        point
        for point in points
        if point and fits(point, settings) and json.dumps(point, sort_keys=True) not in given
    ]


def _warm_start(
    storage: BaseStorage,
    settings: SearchSettings,
    base: str,
    search: str,
    compared: Mapping[str, Any],
) -> tuple[list[dict[str, Any]], str]:
    """The trials of older studies that are in the space, and their studies in words.

    Returns:
        Each trial has its point, `values`, and its objective values, `judged`.

    Raises:
        StorageError: There are none.
    """
    warm = settings.warm_start
    if warm is None:
        return [], ""
    if warm.storage is not None:
        storage = open_studies(warm.storage, warm_start=True)
    older = _older_studies(storage, warm, search)
    trials, ended = [], 0
    for study in older:
        for trial in storage.get_all_trials(study._study_id, deepcopy=False):
            ended += trial.state.is_finished()
            values = _translated(study, trial, settings, compared)
            if values is not None:
                trials.append({"values": values, "judged": list(trial.values)})
    names = ", ".join(study.study_name for study in older)
    if not trials:
        raise StorageError(
            f"search.warm_start.study must have complete trials with the objectives of {base} "
            f"and in its space, got {names}: none of {ended} trials"
        )
    return trials, f"warm start from {len(trials)} of {ended} trials of {names}"


def _older_studies(storage: BaseStorage, warm: WarmStart, search: str) -> list[Any]:
    """The studies of the newest search whose names begin with the wanted name."""

    def search_of(study: Any) -> str:
        """The search of a study; a study that is not ours is a search of its own."""
        return str(study.user_attrs.get(SEARCH, study.study_name))

    others = [study for study in studies_of(storage) if study.user_attrs.get(SEARCH) != search]
    matching = [study for study in others if study.study_name.startswith(warm.study)]
    if not matching:
        raise no_study_error(warm, [study.study_name for study in others])
    return [study for study in matching if search_of(study) == search_of(matching[-1])]


def _translated(
    study: Any, trial: FrozenTrial, settings: SearchSettings, compared: Mapping[str, Any]
) -> dict[str, Any] | None:
    """The point of another study's trial as a point of this study; None if it does not fit."""
    if trial.state is not TrialState.COMPLETE or trial.values is None:
        return None
    if list(study.directions) != directions_of(settings):
        return None
    values = study.user_attrs.get(COMPARED, {}) | trial.user_attrs.get(VALUES, dict(trial.params))
    for name, value in compared.items():
        if name in values and not same(values.pop(name), value):
            return None  # it has another compared value
    return values if fits(values, settings) else None
