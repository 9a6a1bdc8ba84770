"""The attributes that a study and its trials have in Optuna's storage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from music_rllib.config.search import SearchSettings

# Of a study.
FINGERPRINT, SETTINGS = "music_rllib:fingerprint", "music_rllib:settings"
POINTS, PRIOR = "music_rllib:points", "music_rllib:prior"
LEARNT, BASE = "music_rllib:learnt", "music_rllib:base"
SEARCH, ARM = "music_rllib:search", "music_rllib:arm"
# Of a trial.
OWNER, VALUES, REASON, SCORES = "owner", "values", "reason", "scores"
LOST = "lost"
"""It failed because a run of its did, and not by its values."""


@dataclass(frozen=True, kw_only=True)
class Identity:
    """The names and hashes that tell a study from others."""

    base: str
    """`sweep/stage`, followed by the compared values."""
    fingerprint: str
    """Hash of everything that determines the study's points and values."""
    search: str
    """Name and hash of the search, which the studies of all compared values share."""

    @property
    def name(self) -> str:
        """The study's name in the storage."""
        return f"{self.base} @{self.fingerprint}"


def fits(values: Mapping[str, Any], settings: SearchSettings) -> bool:
    """Whether a point lies in the space."""
    seen: dict[str, Any] = {}
    for name, dimension in settings.space.items():
        exists = dimension.applies(seen)
        if exists != (name in values) or (exists and not dimension.contains(values[name])):
            return False
        if exists:
            seen[name] = values[name]
    return len(seen) == len(values)
