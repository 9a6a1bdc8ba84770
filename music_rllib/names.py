"""Names of all metrics, tags and params in MLflow, and labels of runs.

A metric is called ``group/name``, because MLflow's chart page groups by it. MLflow allows letters,
digits, ``_ - . : /`` and space, at most 250 characters, and no empty path part (``//`` or a leading
``/``).
"""

from __future__ import annotations

import re
from collections.abc import Iterable

# Counters -----------------------------------------------------------------------------------
ENV_STEPS = "env_steps"
"""Environment steps of the run so far; the MLflow step of every other metric."""
GRAD_UPDATES = "grad_updates"
"""Gradient updates of the run so far."""

# Deterministic evaluation episodes ------------------------------------------------------------
EVAL_SUCCESS = "evaluation/success_rate"
"""Share of episodes that succeed at their last step."""
EVAL_SUCCESS_ANY = "evaluation/success_rate_any_step"
"""Share of episodes that succeed at any step."""
EVAL_RETURN = "evaluation/episode_return"
"""Mean undiscounted task return of an episode."""
EVAL_DISPLACEMENT = "evaluation/object_displacement"
"""Mean distance in meters between the object's first and last position of an episode."""
EVAL_TOUCHED = "evaluation/object_moved_share"
"""Share of episodes in which the object was moved."""
EVAL_EPISODES = "evaluation/episodes"
"""Number of episodes behind the evaluation metrics of this step."""
EVAL_RATES = frozenset({EVAL_SUCCESS, EVAL_SUCCESS_ANY, EVAL_TOUCHED})
"""Evaluation metrics that are a share of the episodes."""


def primary_metric(success_key: str | None) -> str:
    """The metric for comparing runs on a task: success rate if declared, otherwise return.

    Args:
        success_key: that of the task; None, or `None` as text in MLflow, if it declares no success.
    """
    return EVAL_RETURN if success_key in (None, "None") else EVAL_SUCCESS


def word_of(metric: str) -> str:
    """The word for an evaluation metric in a line of text; the name of any other metric."""
    words = {EVAL_SUCCESS: "success", EVAL_RETURN: "return", EVAL_DISPLACEMENT: "moved"}
    return words.get(metric, metric)


# Training episodes (exploring policy) ---------------------------------------------------------
TRAIN_SUCCESS = "training/success_rate"
TRAIN_SUCCESS_ANY = "training/success_rate_any_step"
TRAIN_RETURN = "training/episode_return"
TRAIN_DISPLACEMENT = "training/object_displacement"
TRAIN_TOUCHED = "training/object_moved_share"

# MUSIC ----------------------------------------------------------------------------------------
MI_BOUND = "mutual_information/bound"
"""Donsker-Varadhan bound on I(surrounding state; agent state), in nats."""
MI_REWARD = "mutual_information/reward"
"""Mean intrinsic reward of the sampled transitions, before its weight."""

# Other intrinsic rewards ------------------------------------------------------------------------
INTRINSIC_REWARD = "intrinsic/reward"
"""Mean reward of the sampled transitions, in [-1, 0], before its weight."""
INTRINSIC_BONUS = "intrinsic/bonus"
"""Mean bonus of the sampled transitions, before it is scaled."""

# Learning: means over the updates since the last report ------------------------------------------
CRITIC_LOSS = "loss/critics"
VALUE_LOSS = "loss/value"
POLICY_LOSS = "loss/policy"
INTRINSIC_LOSS = "loss/intrinsic"
"""Loss of the networks of an intrinsic reward other than MUSIC's."""
Q_MEAN = "critics/mean"
"""Mean of Q1 and Q2 over the sampled transitions."""
ENTROPY = "entropy/tsallis"
"""S_q of the policy in the form that the loss uses (per dimension summed, or joint)."""
SHANNON_ENTROPY = "entropy/shannon"
"""Shannon entropy of the joint policy on [-1, 1]^A, in nats."""
ENTROPIES = (SHANNON_ENTROPY, ENTROPY)
"""Entropies of the whole policy, over all action dimensions."""
CLIPPED_DENSITIES = "bounds/density_share"
"""Share of densities so extreme that ln_q is replaced by its tangent (`tsallis.MAX_EXPONENT`)."""
LOG_STD_AT_BOUND = "bounds/log_std_share"
"""Share of log standard deviations at an end of their range."""
ENTROPIC_INDEX = "schedule/entropic_index"
ALPHA = "schedule/alpha"
MI_REWARD_WEIGHT = "schedule/mi_reward_weight"
INTRINSIC_WEIGHT = "schedule/intrinsic_weight"
ENTROPIC_INDEX_FOLLOWS = "schedule/entropic_index_follows"
MI_REWARD_WEIGHT_FOLLOWS = "schedule/mi_reward_weight_follows"
INTRINSIC_WEIGHT_FOLLOWS = "schedule/intrinsic_weight_follows"
FOLLOWED = {
    ENTROPIC_INDEX: ENTROPIC_INDEX_FOLLOWS,
    MI_REWARD_WEIGHT: MI_REWARD_WEIGHT_FOLLOWS,
    INTRINSIC_WEIGHT: INTRINSIC_WEIGHT_FOLLOWS,
}
"""A setting's metric to the metric of the quantity that it follows: a success rate, or an entropy
in nats, smoothed and monotone as configured."""
CLIPPED_TARGETS = "bounds/target_share"
"""Share of critic targets that lie on `tac.target_bounds`."""
Q_BIAS = "critics/bias"
"""Smallest critic at the first step of fresh episodes, minus the return of the episode."""
HELD_OUT_BOUND = "mutual_information/held_out_bound"
"""The bound on fresh episodes, before the estimator is trained on them, in nats."""
MI_REWARD_LOWEST = "mutual_information/reward_share_lowest"
MI_REWARD_HIGHEST = "mutual_information/reward_share_highest"
"""Shares of sampled transitions whose intrinsic reward is clipped to -1 and to 0."""
SHANNON_OF_DIMENSION = "entropy/shannon_dimension_"
"""Prefix; with an action dimension: the dimension's Shannon entropy, in nats."""
ENTROPY_OF_DIMENSION = "entropy/tsallis_dimension_"
"""Prefix; with an action dimension: the dimension's S_q."""

LEARNER_GROUPS = (
    "bounds/", "critics/", "entropy/", "intrinsic/", "loss/", "mutual_information/", "schedule/",
)  # fmt: skip
"""Beginnings of the names of the Learner's metrics."""

# Measured in the worker, logged with the other metrics ------------------------------------------
SYSTEM_CPU = "system/cpu_utilization_percentage"
SYSTEM_MEMORY = "system/process_memory_megabytes"
SYSTEM_SECONDS = "system/training_seconds"
"""Training time so far, without pauses. Frames and exports have it, MLflow does not."""

# Settings of a run as metrics: MLflow compares params as text, so that `q > 1` needs a metric ---
SETTING_ENTROPIC_INDEX = "setting/entropic_index"
SETTING_ALPHA = "setting/alpha"
SETTING_MI_REWARD_WEIGHT = "setting/mi_reward_weight"

GROUPS = (
    "bounds", "critics", "entropy", "evaluation", "intrinsic", "loss",
    "mutual_information", "schedule", "setting", "system", "training",
)  # fmt: skip
"""Groups of the metrics above."""

# Tags -------------------------------------------------------------------------------------------
TAG_PARENT_RUN = "mlflow.parentRunId"
"""MLflow's tag that nests a run below another."""
TAG_KIND = "kind"
"""``sweep`` for the parent run, ``run`` for a child run."""
KIND_SWEEP = "sweep"
KIND_RUN = "run"
TAG_SWEEP = "sweep"
"""Name of the sweep."""
TAG_SWEEP_ID = "sweep_id"
"""Distinguishes sweeps of the same name on one server; kept in the sweep's folder."""
TAG_NODE_KEY = "node_key"
"""Content hash of the run's settings and source, which identifies a child run."""
TAG_ENVIRONMENT = "environment"
"""Hash of the run's environment apart from its settings: source code, models, versions."""
TAG_RESULT = "result"
"""Hash of a finished run's history; with another hash, the run is of an earlier training."""
TAG_PLAN = "plan"
"""Hash of the sweep's plan, on the parent run. A changed plan has its own parent run, because
MLflow's params never change."""
TAG_CURRENT = "current"
"""``yes`` for the parent run of the current plan and for its runs, ``no`` for those of earlier
plans."""
CURRENT, SUPERSEDED = "yes", "no"
TAG_LABEL = "label"
"""The run's label in the sweep, which `evaluate` accepts."""
TAG_STAGE = "stage"
TAG_TRIAL = "trial"
TAG_VARIANT = "variant"
TAG_TASK = "task"
TAG_SEED = "seed"
TAG_ENTROPIC_INDEX = "entropic_index"
TAG_ALPHA = "alpha"
TAG_MI_REWARD_WEIGHT = "mi_reward_weight"
TAG_CONFIG_HASH = "config_hash"
TAG_SOURCE_RUN = "source_run"
"""MLflow run id of the run whose handoff initializes this run."""
TAG_SOURCE_NODE = "source_node"
"""Node key of the run, or hash of the imported handoff, that initializes this run."""
TAG_INCOMPLETE = "incomplete"
"""Set on a finished run until its policy is logged."""
TAG_PART = "part"
"""In a searched stage: ``trialN`` for a run of the search, ``finalN`` for a run of the final
ranking on fresh seeds. Estimates never mix both: selection biases the former."""
TAG_PRUNED = "pruned"
"""Why the run was pruned, together with its trial."""
TAG_EARLIER_RESULT = "earlier_result"
"""Time in ms of the first result of an earlier plan's run with other `env_steps`, which begins like
this run. Only in exports and in sweeps read from the storage."""
TAG_FAILURE = "failure"
"""First lines of the cause of a failed run."""
TAG_GIT_COMMIT = "git_commit"
"""Commit of the code, with ``-dirty`` if tracked files were changed."""
TAG_VERSION_PREFIX = "version."
"""Prefix of a package or ``python``: ``version.ray``."""
TAG_VERSIONS_CHANGED = "versions_changed"
"""Versions that changed while the run was trained; only in its record in the storage."""
TAG_ALGORITHM = TAG_VERSION_PREFIX + "algorithm"
"""`ALGORITHM_VERSION`; runs without this tag have version 2."""
TAG_VIEW_PREFIX = "mlflow.sharedViewState."
"""MLflow's prefix of the key of an experiment's view."""
TAG_NOTE = "mlflow.note.content"
"""MLflow's tag for the description of a run, in Markdown."""
EXPERIMENT_TAGS = {"mlflow.experimentKind": "custom_model_development"}
"""Without it, MLflow 3 shows an experiment on language models: traces, judges, prompts."""
TAGS_OF_A_MODEL = (
    TAG_SWEEP, TAG_SWEEP_ID, TAG_NODE_KEY, TAG_STAGE, TAG_TRIAL, TAG_VARIANT,
    TAG_TASK, TAG_SEED, TAG_ENTROPIC_INDEX, TAG_ALPHA, TAG_MI_REWARD_WEIGHT,
)  # fmt: skip
"""Tags of a run that its logged policy also has, in addition to ``source_run``."""

# Artifacts --------------------------------------------------------------------------------------
ARTIFACT_SWEEP_CONFIG = "config/sweep.yaml"
ARTIFACT_SEARCH = "search/search.json"
"""Trials, values, reasons, importance and the ranking on fresh seeds of a sweep's searches."""
ARTIFACT_ANALYSIS_PLAN = "analysis/analysis_plan.json"
"""Versions of the sweep's analysis plan, each with the time at which it was recorded."""

# Environment variables --------------------------------------------------------------------------
VARIABLE_TRACKING_URI = "MUSIC_RLLIB_TRACKING_URI"
"""MLflow server for the report at a sweep's end, password included."""
VARIABLE_STORAGE = "MUSIC_RLLIB_STORAGE"
"""Storage for the report at a sweep's end, if it is a bucket."""
VARIABLE_REPORT = "MUSIC_RLLIB_REPORT"
"""`off`: write no report at a sweep's end."""
VARIABLE_PROGRESS = "MUSIC_RLLIB_PROGRESS"
"""`all`: print each evaluation, not only one line in 30 seconds for each run."""
VARIABLE_STUDIES = "MUSIC_RLLIB_STUDIES"
"""Folder for studies without a database, in place of the sweep's: each driver then has its own."""


SYMBOLS = {"q": "entropic_index", "weight": "mi_reward_weight"}
"""Short name of a setting in papers, tables and labels to its name."""
_NAME = re.compile(r"(?<![\w.])(?:(?:tac|music|replay|evaluation)\.)?(\w+)(?==)")
_ITEM = re.compile(r",(?=[\w:.-]+=)")


def in_runs(number: int) -> str:
    """A number of runs in text: `1 run`, `2 runs`."""
    return "1 run" if number == 1 else f"{number} runs"


class ShortLabels:
    """Shortens labels of a sweep: omits a stage or task that all runs have, uses symbols."""

    def __init__(self, stages: Iterable[str], tasks: Iterable[str]) -> None:
        self._stages, self._tasks = set(stages), set(tasks)

    @classmethod
    def of(cls, labels: Iterable[str]) -> ShortLabels:
        """Create it for a sweep whose runs have these labels."""
        parts = [label.split("/") for label in labels]
        return cls((part[0] for part in parts), (part[1] for part in parts if len(part) > 1))

    def __call__(self, label: str) -> str:
        """The short form of `label`; other text is returned unchanged."""
        stage, _, rest = label.partition("/")
        task, _, rest = rest.partition("/")
        if stage not in self._stages or task not in self._tasks or not rest:
            return label
        kept = [stage] * (len(self._stages) > 1) + [task] * (len(self._tasks) > 1)
        return "/".join((*kept, _NAME.sub(_symbol, rest)))


def symbol(setting: str) -> str:
    """The short form of a setting: `q` for `tac.entropic_index`, `alpha` for `tac.alpha`."""
    return _NAME.sub(_symbol, f"{setting}=").removesuffix("=")


def _symbol(match: re.Match[str]) -> str:
    return next((symbol for symbol, name in SYMBOLS.items() if name == match[1]), match[1])


def label_matches(wanted: str, label: str) -> bool:
    """Whether every part of `wanted`, short or complete, is a part of `label`, in any order."""
    parts = [_items(part) for part in label.split("/")]
    return all(
        any(all(any(_same(item, other) for other in part) for item in given) for part in parts)
        for given in map(_items, wanted.strip("/").split("/"))
    )


def _items(part: str) -> list[tuple[str, str]]:
    """Names and values of `tac.lr=0.1,q=2`; `FetchPush` and `seed0` are names without values."""
    pairs = [item.partition("=")[::2] for item in _ITEM.split(part)]
    return [(f"seed{value}", "") if name == "seed" else (name, value) for name, value in pairs]


def _same(given: tuple[str, str], item: tuple[str, str]) -> bool:
    """Whether a given name and value equal those of a label's item."""
    name = SYMBOLS.get(given[0], given[0])
    if name != item[0] and not item[0].endswith((f".{name}", f":{name}")):
        return False
    return given[1] == item[1] or _number(given[1]) == _number(item[1]) is not None


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
