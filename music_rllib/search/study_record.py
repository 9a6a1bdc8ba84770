"""What a study keeps of itself and of its trials in Optuna's storage, and by which keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from optuna.trial import FrozenTrial, create_trial

from music_rllib.config.search.settings import SearchSettings
from music_rllib.search.sampler import as_proposal

__all__ = [
    "ARM",
    "BASE",
    "FINGERPRINT",
    "LEARNT",
    "OWNER",
    "POINTS",
    "PRIOR",
    "REASON",
    "SCORES",
    "SEARCH",
    "SETTINGS",
    "VALUES",
    "Identity",
    "as_data",
    "fits",
    "from_data",
]

FINGERPRINT, SETTINGS, POINTS, PRIOR, LEARNT, BASE, SEARCH, ARM = (
    "music_rllib:fingerprint",
    "music_rllib:settings",
    "music_rllib:points",
    "music_rllib:prior",
    "music_rllib:learnt",
    "music_rllib:base",
    "music_rllib:search",
    "music_rllib:arm",
)
OWNER, VALUES, REASON, SCORES = "owner", "values", "reason", "scores"


@dataclass(frozen=True, kw_only=True)
class Identity:
    """What makes a study this study."""

    base: str
    """`sweep/stage`, with the compared values behind it."""
    fingerprint: str
    """Hash of all that determines its points and values."""
    search: str
    """The same for all compared values: theirs are the studies of one search."""

    @property
    def name(self) -> str:
        """In the storage."""
        return f"{self.base} @{self.fingerprint}"


def fits(values: Mapping[str, Any], settings: SearchSettings) -> bool:
    """Whether a point lies in the space."""
    seen: dict[str, Any] = {}
    for name, dimension in settings.space.items():
        if not dimension.applies(seen):
            if name in values:
                return False
            continue
        if name not in values:
            return False
        if not dimension.contains(values[name]):
            return False
        seen[name] = values[name]
    return len(seen) == len(values)


def as_data(trial: FrozenTrial) -> dict[str, Any]:
    """What `from_data` makes the trial of again, as JSON."""
    return {"values": trial.user_attrs[VALUES], "judged": list(trial.values or [])}


def from_data(data: Mapping[str, Any], settings: SearchSettings) -> FrozenTrial:
    """A trial of an older study, without what its sampler kept: that may be a pickle."""
    proposal = as_proposal(settings.space, data["values"])
    return create_trial(
        values=list(data["judged"]),
        params=dict(proposal.params),
        distributions=dict(proposal.distributions),
        user_attrs={VALUES: dict(data["values"])},
    )
