"""Creates studies in Optuna's storage, with the points that they start from.

The name of a study holds a hash of everything that determines its points and values: changed
settings make another study, which first evaluates the points of the earlier one again. Their runs
are in the store, so only new runs are trained.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

from optuna.exceptions import DuplicatedStudyError
from optuna.storages import BaseStorage

from music_rllib.config.search import SearchSettings
from music_rllib.experiment.plan import short
from music_rllib.search.sampler import VALUES, directions_of
from music_rllib.search.storage import studies_of
from music_rllib.store.serialization import content_key

# Attributes of a study.
FINGERPRINT, SETTINGS = "music_rllib:fingerprint", "music_rllib:settings"
BASE, SEARCH, COMPARED = "music_rllib:base", "music_rllib:search", "music_rllib:arm"
POINTS = "music_rllib:points"
"""Points of the first trials; it is set last, when all other attributes are there."""

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
    """
    own = _own_settings(settings)
    search = f"{base} @{content_key([own, determined_by])}"
    base = "/".join((base, *(f"{name}={short(value, name)}" for name, value in compared.items())))
    fingerprint = content_key([own, {**determined_by, "arm": dict(compared)}])
    name = f"{base} @{fingerprint}"

    def attributes() -> dict[str, Any]:
        """Attributes of a new study, which stay the same if older studies change."""
        earlier = _earlier_points(storage, settings, base, name)
        return {
            FINGERPRINT: fingerprint,
            BASE: base,
            SEARCH: search,
            COMPARED: dict(compared),
            SETTINGS: own,
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


def _own_settings(settings: SearchSettings) -> dict[str, Any]:
    """The settings that determine points and values: neither number of trials nor storage."""
    excluded = {"trials", "final", "study", "storage", "compare", "mode"}
    return settings.model_dump(mode="json", by_alias=True, exclude=excluded)


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
