"""Every metric, tag and parameter name that reaches MLflow, in one place (no imports).

Names use ``group/name``, so that MLflow's chart page groups them. Allowed are letters, digits,
``_ - . : /`` and space, at most 250 characters, and no empty path part (``//`` or a leading ``/``).
"""

# Counters -----------------------------------------------------------------------------------
ENV_STEPS = "env_steps"
"""Environment steps of this run so far; the MLflow step of every other metric."""
GRAD_UPDATES = "grad_updates"
"""Gradient updates of this run so far."""

# Deterministic evaluation episodes ------------------------------------------------------------
EVAL_SUCCESS = "evaluation/success_rate"
"""Share of episodes that succeed at their last step."""
EVAL_SUCCESS_ANY = "evaluation/success_rate_any_step"
"""Share of episodes that succeed at any step."""
EVAL_RETURN = "evaluation/episode_return"
"""Mean undiscounted task return of an episode."""
EVAL_DISPLACEMENT = "evaluation/object_displacement"
"""Mean distance in metres between the object's first and last position of an episode."""
EVAL_TOUCHED = "evaluation/object_moved_share"
"""Share of episodes in which the object was moved."""
EVAL_EPISODES = "evaluation/episodes"
"""Number of episodes behind the evaluation metrics of this step."""
EVAL_RATES = frozenset({EVAL_SUCCESS, EVAL_SUCCESS_ANY, EVAL_TOUCHED})
"""Those that are a share of the evaluation episodes."""


def primary_metric(success_key: str | None) -> str:
    """What runs on a task are judged by: its success rate, or the return where none is declared.

    Args:
        success_key: the task's; None, or `None` as MLflow keeps it, where it has no success.
    """
    return EVAL_RETURN if success_key in (None, "None") else EVAL_SUCCESS


def word_of(metric: str) -> str:
    """An evaluation metric in a line of text; other metrics are called by their name."""
    return {EVAL_SUCCESS: "success", EVAL_RETURN: "return"}.get(metric, metric)


# Training episodes (exploring policy) ---------------------------------------------------------
TRAIN_SUCCESS = "training/success_rate"
TRAIN_SUCCESS_ANY = "training/success_rate_any_step"
TRAIN_RETURN = "training/episode_return"
TRAIN_DISPLACEMENT = "training/object_displacement"

# MUSIC ----------------------------------------------------------------------------------------
MI_BOUND = "mutual_information/bound"
"""Donsker-Varadhan bound on I(surrounding state; agent state), in nats."""
MI_REWARD = "mutual_information/reward"
"""Mean intrinsic reward of the sampled transitions, before its weight."""

# Learning: means over the updates since the last report ------------------------------------------
CRITIC_LOSS = "loss/critics"
VALUE_LOSS = "loss/value"
POLICY_LOSS = "loss/policy"
Q_MEAN = "critics/mean"
"""Mean of Q1 and Q2 over the sampled transitions."""
ENTROPY = "entropy/tsallis"
"""S_q of the policy in the form that the loss uses (per dimension summed, or joint)."""
SHANNON_ENTROPY = "entropy/shannon"
"""Shannon entropy of the joint policy on [-1, 1]^A, in nats."""
ENTROPIES = (SHANNON_ENTROPY, ENTROPY)
"""Of the whole policy."""
CLIPPED_DENSITIES = "bounds/density_share"
"""Share of densities beyond which ln_q follows its tangent (`tsallis.MAX_EXPONENT`)."""
LOG_STD_AT_BOUND = "bounds/log_std_share"
"""Share of log standard deviations at an end of their range."""
ENTROPIC_INDEX = "schedule/entropic_index"
ALPHA = "schedule/alpha"
MI_REWARD_WEIGHT = "schedule/mi_reward_weight"
ENTROPIC_INDEX_FOLLOWS = "schedule/entropic_index_follows"
MI_REWARD_WEIGHT_FOLLOWS = "schedule/mi_reward_weight_follows"
FOLLOWED = {
    ENTROPIC_INDEX: ENTROPIC_INDEX_FOLLOWS,
    MI_REWARD_WEIGHT: MI_REWARD_WEIGHT_FOLLOWS,
}
"""Setting to the success rate, or entropy in nats, that it is a function of: smoothed, and monotone
where asked."""


CLIPPED_TARGETS = "bounds/target_share"
"""Share of critic targets on `tac.target_bounds`."""
Q_BIAS = "critics/bias"
"""Smallest critic at the first step of fresh episodes, minus the return that followed there."""
HELD_OUT_BOUND = "mutual_information/held_out_bound"
"""The bound on fresh episodes, before the estimator is trained on them, in nats."""
MI_REWARD_LOWEST = "mutual_information/reward_share_lowest"
MI_REWARD_HIGHEST = "mutual_information/reward_share_highest"
"""Shares of sampled transitions whose intrinsic reward is clipped to -1 and to 0."""

SHANNON_OF_DIMENSION = "entropy/shannon_dimension_"
"""Followed by the action dimension: its Shannon entropy, in nats."""
ENTROPY_OF_DIMENSION = "entropy/tsallis_dimension_"
"""Followed by the action dimension: S_q of it alone."""
PER_DIMENSION = (ENTROPY_OF_DIMENSION, SHANNON_OF_DIMENSION)

LEARNER = frozenset(
    {
        MI_BOUND,
        MI_REWARD,
        CRITIC_LOSS,
        VALUE_LOSS,
        POLICY_LOSS,
        Q_MEAN,
        ENTROPY,
        SHANNON_ENTROPY,
        CLIPPED_DENSITIES,
        LOG_STD_AT_BOUND,
        CLIPPED_TARGETS,
        Q_BIAS,
        HELD_OUT_BOUND,
        MI_REWARD_LOWEST,
        MI_REWARD_HIGHEST,
        ENTROPIC_INDEX,
        ALPHA,
        MI_REWARD_WEIGHT,
        ENTROPIC_INDEX_FOLLOWS,
        MI_REWARD_WEIGHT_FOLLOWS,
    }
)
"""What the Learner logs, beside the entropies of single dimensions."""


# Measured in the worker, logged with the other metrics ------------------------------------------
SYSTEM_CPU = "system/cpu_utilization_percentage"
SYSTEM_MEMORY = "system/process_memory_megabytes"

# A run's settings that are metrics too: MLflow compares params as text, so `q > 1` needs one ---
SETTING_ENTROPIC_INDEX = "setting/entropic_index"
SETTING_ALPHA = "setting/alpha"
SETTING_MI_REWARD_WEIGHT = "setting/mi_reward_weight"

GROUPS = (
    "bounds",
    "critics",
    "entropy",
    "evaluation",
    "loss",
    "mutual_information",
    "schedule",
    "setting",
    "system",
    "training",
)
"""Of the names above."""

# Tags -------------------------------------------------------------------------------------------
TAG_PARENT_RUN = "mlflow.parentRunId"
"""MLflow's own tag that nests a run below another."""
TAG_KIND = "kind"
"""``sweep`` for the parent run, ``run`` for a child run."""
KIND_SWEEP = "sweep"
KIND_RUN = "run"
TAG_SWEEP = "sweep"
"""Name of the sweep."""
TAG_SWEEP_ID = "sweep_id"
"""Tells apart sweeps of the same name that share a server; kept in the sweep's folder."""
TAG_NODE_KEY = "node_key"
"""Content hash of the node; a child run is found again by it."""
TAG_LABEL = "label"
"""What the run is called in the sweep, and by `sweep evaluate`."""
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
"""MLflow run id of the run whose handoff this run starts from."""
TAG_SOURCE_NODE = "source_node"
"""Node key, or checkpoint hash, of what this run starts from."""
TAG_REUSED = "reused"
"""``true`` where the node was finished by an earlier sweep and its history was copied here."""
TAG_INCOMPLETE = "incomplete"
"""On a finished run while its learning curve and policy are still to come."""
TAG_PART = "part"
"""Of a searched stage: ``trialN`` for a run that trials were chosen by, ``finalN`` for one on the
fresh seeds of the final ranking. Never mixed in one estimate: the choice biases the first."""
TAG_PRUNED = "pruned"
"""Why a run was stopped early, together with its trial."""
TAG_FAILURE = "failure"
"""First lines of the cause of a failed run."""
TAG_GIT_COMMIT = "git_commit"
"""Commit of the code, with ``-dirty`` where tracked files were changed."""
TAG_VERSION_PREFIX = "version."
"""Followed by a package or ``python``: ``version.ray``."""
TAG_ALGORITHM = TAG_VERSION_PREFIX + "algorithm"
"""Version of what is computed; runs without this tag are of version 2."""
TAG_CHANGED_PREFIX = "changed."
"""Followed by a param: its newer value (MLflow params never change) after a sweep was changed."""
TAG_VIEW_PREFIX = "mlflow.sharedViewState."
"""MLflow's own, of an experiment, followed by a view's key."""
TAG_NOTE = "mlflow.note.content"
"""MLflow's own: what the run's page shows as its description, in Markdown."""
EXPERIMENT_TAGS = {"mlflow.experimentKind": "custom_model_development"}
"""MLflow 3 shows an experiment without it as one of language models: traces, judges, prompts."""
TAGS_OF_A_MODEL = (
    TAG_SWEEP,
    TAG_SWEEP_ID,
    TAG_NODE_KEY,
    TAG_STAGE,
    TAG_TRIAL,
    TAG_VARIANT,
    TAG_TASK,
    TAG_SEED,
    TAG_ENTROPIC_INDEX,
    TAG_ALPHA,
    TAG_MI_REWARD_WEIGHT,
)
"""What a logged policy is tagged with, besides ``source_run``: the run's own values."""
TAG_MLFLOW_SOURCE_NAME = "mlflow.source.name"
"""MLflow's own tag behind its *Source* column."""

# Artefacts --------------------------------------------------------------------------------------
ARTEFACT_SWEEP_CONFIG = "config/sweep.yaml"
ARTEFACT_SEARCH = "search/search.json"
"""Trials, values, reasons, importance and the ranking on fresh seeds of a sweep's searches."""
ARTEFACT_ANALYSIS_PLAN = "analysis/analysis_plan.json"
"""Versions of the sweep's analysis plan, each with the time at which it was recorded."""
ARTEFACT_RUN_CONFIG = "config/run.yaml"
ARTEFACT_LEARNING_CURVE = "learning_curve.png"
ARTEFACT_POLICY = "policy.safetensors"
"""The final policy on its way to MLflow, where it becomes the run's logged model."""

# Environment variables --------------------------------------------------------------------------
VARIABLE_TRACKING_URI = "MUSIC_RLLIB_TRACKING_URI"
"""Tells the report of a sweep's end where to read, password included."""
VARIABLE_STORAGE = "MUSIC_RLLIB_STORAGE"
"""The same of the sweep's storage, where that is a bucket."""
VARIABLE_REPORT = "MUSIC_RLLIB_REPORT"
"""`off`: no report at a sweep's end."""
