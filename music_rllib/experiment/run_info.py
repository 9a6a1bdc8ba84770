"""The name, tags and parameters of a node's run in MLflow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from music_rllib import names
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.tac_settings import (
    Alpha,
    LearnedAlpha,
    MatchedAlpha,
    NormalisedAlpha,
    setting_text,
)
from music_rllib.envs.fingerprint import Fingerprint, digest_of
from music_rllib.experiment.plan import Node, short
from music_rllib.schedules import AdaptiveSchedule, value_at
from music_rllib.store.serialization import content_key
from music_rllib.version import ALGORITHM_VERSION


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """The representation of a run in MLflow."""

    node_key: str
    name: str
    """The name in MLflow's lists, for example `q=1.5 seed 0 FetchPush finetune`."""
    config: Mapping[str, object]
    """All settings of the run, which become MLflow's params."""
    tags: Mapping[str, object] = field(default_factory=dict)
    """`names.TAG_*` to values; None is omitted."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """`names.SETTING_*` to numbers, logged as metrics at step 0, so that MLflow compares them."""
    source_node: str | None = None
    """Node key of the run that this one starts from."""


_SHORT = {"tac.entropic_index": "q", "music.mi_reward_weight": "weight"}


def run_name(node: Node) -> str:
    """Varied settings first, then task and stage: `q=1.5 seed 0 FetchPush finetune`."""
    counts = Counter(name.rpartition(".")[2] for name in node.values)
    parts = []
    for name, value in sorted(node.values.items(), key=lambda item: item[0] not in _SHORT):
        last = name.rpartition(".")[2]
        shown = _SHORT.get(name, last if counts[last] == 1 and ":" not in name else name)
        parts.append(f"{shown}={short(value, name)}")
    seed = f"seed {node.run.seed}"
    return " ".join(filter(None, (*parts, seed, node.run.task.name, node.stage, node.part)))


def run_info(node: Node, environment: Fingerprint | None = None) -> RunInfo:
    """The representation in MLflow of a node whose environment has this fingerprint."""
    run = node.run
    config: dict[str, Any] = run.model_dump(mode="json")
    q, alpha, weight = run.tac.entropic_index, run.tac.alpha, run.music.mi_reward_weight
    return RunInfo(
        node_key=node.key,
        name=run_name(node),
        config=config,
        tags={
            names.TAG_LABEL: node.label,
            names.TAG_ENVIRONMENT: None if environment is None else digest_of(environment),
            names.TAG_STAGE: node.stage,
            names.TAG_TRIAL: node.trial,
            names.TAG_PART: node.part or None,
            names.TAG_VARIANT: run.variant,
            names.TAG_TASK: run.task.name,
            names.TAG_SEED: run.seed,
            names.TAG_ENTROPIC_INDEX: setting_text(q),
            names.TAG_ALPHA: setting_text(alpha),
            names.TAG_MI_REWARD_WEIGHT: setting_text(weight),
            names.TAG_CONFIG_HASH: content_key(config),
            names.TAG_ALGORITHM: ALGORITHM_VERSION,
            names.TAG_SOURCE_NODE: node.source_key,
        },
        settings={
            names.SETTING_ENTROPIC_INDEX: _at_start(q, run),
            names.SETTING_ALPHA: _at_start(alpha, run),
            names.SETTING_MI_REWARD_WEIGHT: _at_start(weight, run),
        },
        source_node=node.input.key if node.input and not node.input.checkpoint else None,
    )


def _at_start(value: AdaptiveSchedule | Alpha, run: RunSettings) -> float:
    """The value of a setting at environment step 0."""
    if isinstance(value, LearnedAlpha):
        return value.initial
    # The number in the settings is alpha at q = 1; its value at q is a metric of the run.
    given = value.value if isinstance(value, MatchedAlpha | NormalisedAlpha) else value
    return value_at(given, 0, run.env_steps)
