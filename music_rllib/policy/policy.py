"""Find a run's policy by its key, label or place, and load it without Ray or unpickling."""

from __future__ import annotations

import contextlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.config.load import declared_tasks
from music_rllib.config.problems import shown
from music_rllib.envs.make import Known, known_environment
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_WEIGHTS_BYTES
from music_rllib.names import label_matches
from music_rllib.policy.network import Floats, PolicyFileError, PolicyNetwork
from music_rllib.redaction import redact
from music_rllib.store.handoff import MANIFEST as HANDOFF_FILE
from music_rllib.store.handoff import (
    HandoffError,
    HandoffInfo,
    open_handoff,
    read_handoff,
)
from music_rllib.store.sealed import MANIFEST, SealedFolders
from music_rllib.store.storage import (
    StorageError,
    StorageFolder,
    below,
    database_url,
    open_storage,
    resolve_storage,
)

MLFLOW_FILE = "policy.safetensors"
"""File with the policy in an MLflow model."""
_WEIGHTS = {HANDOFF_FILE, MLFLOW_FILE, f"artifacts/{MLFLOW_FILE}"}
"""Files that a policy needs in addition to those of a handoff."""
_SHORTEST_KEY = 4
"""Shortest beginning of a key that identifies a run."""
_LISTED = 8
"""Number of runs that a message lists."""


class PolicyError(BadInputError, ValueError):
    """A policy can't be loaded; the message names the place and the reason."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """The deterministic policy of a run, with the task and settings of its training."""

    network: PolicyNetwork
    task: Task
    variant: str
    seed: int
    node_key: str
    env_steps: int
    max_episode_steps: int
    """Steps after which episodes are truncated."""
    environment: Known | None
    """The environment of its episodes. None if only the policy's file names it, because a file
    must not choose the code to import."""

    @property
    def observation_size(self) -> int:
        """Features of an observation, without goals."""
        return self.network.observation_size

    @property
    def goal_size(self) -> int:
        """Features of a goal; 0 if the task has none."""
        return self.network.goal_size

    @property
    def input_size(self) -> int:
        """Features of a flat input: observation and goal side by side."""
        return self.network.input_size

    @property
    def action_size(self) -> int:
        """Dimensions of an action."""
        return self.network.action_size

    def act(self, observation: Any) -> Floats:
        """The action in the environment's units, float32 (see `PolicyNetwork.act`)."""
        return self.network.act(observation)

    def to_bytes(self) -> bytes:
        """The content of a policy's file, which `load_policy` reads."""
        return self.network.to_bytes()


def load_policy(place: str | Path, env: str | Sequence[Task] = ()) -> Policy:
    """Load the policy of a finished or unfinished run.

    Nothing that its files name is imported or executed.

    Args:
        place: Folder or `s3://` or `gs://` URI of a finished run (`nodes/KEY`), of a checkpoint
            (`work/KEY/NUMBER`) or of a handoff; a policy's file; or an MLflow URI (`models:/...`,
            `runs:/...`).
        env: The environment of its episodes, if it is neither built in nor part of Gymnasium: its
            id (`module:` in front is imported), or tasks that declare it, as `named_environment`
            reads them from a sweep's YAML file.

    Raises:
        PolicyError: There is no policy, or it is damaged; the message names the place.
    """
    text = str(place)
    try:
        if text.startswith(("models:/", "runs:/")):
            return _from_mlflow(text, env)
        with _local_copy(text) as found:
            return (_from_file if found.is_file() else policy_from_folder)(found, env)
    except (HandoffError, StorageError, PolicyFileError, OSError) as error:
        raise PolicyError(redact(f"{text} must hold a policy: {error}")) from error


def policy_from_folder(folder: Path, env: str | Sequence[Task] = ()) -> Policy:
    """The policy in a local node, checkpoint, handoff or MLflow model; `env` as for `load_policy`.

    Raises:
        PolicyError: The weights don't fit their task or settings, or sub-folders hold several
            policies.
        HandoffError: There are no weights.
    """
    for inside in (MLFLOW_FILE, f"artifacts/{MLFLOW_FILE}"):
        # A handoff's own file of weights has the same name.
        if (folder / inside).is_file() and not (folder / HANDOFF_FILE).is_file():
            return _from_file(folder / inside, env)
    try:
        handoff_parent, manifest = open_handoff(folder)
    except HandoffError as error:
        raise _other_folder(folder) or error from None
    info = manifest.info
    wanted = ["policy", "normaliser"] if info.architecture.normalise_observations else ["policy"]
    parts = read_handoff(handoff_parent, wanted, info.task)
    try:
        network = _network(parts, info)
    except (ValueError, LookupError) as error:
        raise PolicyError(
            f"{handoff_parent} must fit the task {info.task.name}: {error!r}"
        ) from error
    return _policy(network, env)


def _other_folder(folder: Path) -> PolicyError | None:
    """The error for a sweep, or the sub-folders that `best` writes for tasks; None for others."""
    if (folder / "plan.json").is_file():
        return PolicyError(
            f"{folder} must hold a policy, and is a sweep: give one of its runs (for commands its "
            f"label, for load_policy {folder.parent}/nodes/KEY), or write its best policy with "
            f"'music-rllib best {folder}'"
        )
    policies = [str(child.parent) for child in sorted(folder.glob("*/handoff"))]
    if not policies or (folder / "handoff").exists() or (folder / HANDOFF_FILE).exists():
        return None
    return PolicyError(f"{folder} must hold one policy: use {' or '.join(policies[:_LISTED])}")


def _network(parts: Mapping[str, Mapping[str, NDArray[Any]]], info: HandoffInfo) -> PolicyNetwork:
    policy, spaces = parts["policy"], info.spaces
    # torch's names: the layers are every other entry of a Sequential.
    layers = sorted(int(name.removesuffix(".weight")) for name in policy if "weight" in name)
    features = policy[f"{layers[0]}.weight"].shape[1]
    if features != spaces.observation_size + spaces.goal_size:
        raise ValueError(
            f"the weights take {features} inputs, the environment's observations and goals have "
            f"{spaces.observation_size} and {spaces.goal_size}"
        )
    normaliser = parts.get("normaliser")
    limit = min(info.max_episode_steps or info.task.horizon, info.task.horizon)
    clip = info.observation_clip if normaliser else None
    about = info.model_dump(mode="json", exclude={"spaces", "observation_clip"})
    return PolicyNetwork(
        weights=tuple(_floats(policy[f"{i}.weight"]) for i in layers),
        biases=tuple(_floats(policy[f"{i}.bias"]) for i in layers),
        mean=_floats(normaliser["mean"] if normaliser else np.zeros(features)),
        inverse_std=_floats(normaliser["inverse_std"] if normaliser else np.ones(features)),
        clip=float(np.finfo(np.float32).max) if clip is None else clip,
        low=np.asarray(spaces.action_low, np.float32),
        high=np.asarray(spaces.action_high, np.float32),
        goal_size=spaces.goal_size,
        layer_norm=info.architecture.layer_norm == "all",
        about={**about, "max_episode_steps": limit},
    )


def _policy(network: PolicyNetwork, env: str | Sequence[Task]) -> Policy:
    about = network.about
    task = Task.model_validate(about["task"])
    return Policy(
        network=network,
        task=task,
        environment=_environment(task, env),
        variant=str(about["variant"]),
        seed=int(about["seed"]),
        node_key=str(about["node_key"]),
        env_steps=int(about["env_steps"]),
        max_episode_steps=int(about["max_episode_steps"]),
    )


def _environment(task: Task, env: str | Sequence[Task]) -> Known | None:
    if not isinstance(env, str):
        return known_environment(task, env)
    if task.env_kwargs:
        raise PolicyError(
            f"the environment of {task.name} takes arguments, {shown(task.env_kwargs)}: it must be "
            f"declared in a sweep's YAML file to be used, got its id {env!r} alone"
        )
    return Known(env, {})


def _from_file(path: Path, env: str | Sequence[Task]) -> Policy:
    network = PolicyNetwork.from_file(path)
    try:
        return _policy(network, env)
    except PolicyError:
        raise
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"{path} must say what it was trained for: {error}") from error


def _from_mlflow(uri: str, env: str | Sequence[Task]) -> Policy:
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    import mlflow
    from mlflow.exceptions import MlflowException

    try:
        with TemporaryDirectory() as folder:
            server = database_url(mlflow.get_tracking_uri())
            model = mlflow.artifacts.download_artifacts(
                artifact_uri=uri, dst_path=folder, tracking_uri=server
            )
            return policy_from_folder(Path(model), env)
    except MlflowException as error:
        raise PolicyError(
            redact(
                f"{uri} must be a model at {mlflow.get_tracking_uri()} (MLFLOW_TRACKING_URI): "
                f"{error}"
            )
        ) from None  # its message may hold a password


@contextlib.contextmanager
def _local_copy(place: str) -> Iterator[Path]:
    """Yield a verified copy of a sealed folder; any other local folder or file as it is."""
    storage = open_storage(place)
    if storage.is_local:  # the manifest has the name of the folder, not that of a link to it
        storage = replace(storage, path=os.path.realpath(storage.path))
    parent, _, name = storage.path.rpartition("/")
    folders = SealedFolders(replace(storage, path=parent))
    if not folders.exists(name):
        if storage.is_local:
            yield Path(storage.path)
            return
        raise PolicyError(f"{place} must be a finished run or a checkpoint: no {MANIFEST} there")
    with TemporaryDirectory() as folder:
        sizes = {file: entry.bytes for file, entry in folders.manifest(name).files.items()}
        needed = {file for file in sizes if file in _WEIGHTS or file.startswith("handoff/")}
        total = sum(sizes[file] for file in needed)
        if total > MOST_WEIGHTS_BYTES:
            raise PolicyError(
                f"{place} must have at most {MOST_WEIGHTS_BYTES} bytes of weights, it has {total}"
            )
        folders.fetch(name, Path(folder), needed.__contains__)
        yield Path(folder)


def unknown_environment(task: Task) -> str:
    """The message for an environment that is not made, with the options that allow it."""
    arguments = f" with {shown(task.env_kwargs)}" if task.env_kwargs else ""
    return (
        f"the environment of {task.name} must be a built-in task's, one of Gymnasium's, or named "
        f"by you: the policy's file names {shown(task.env_id)}{arguments}, and a file doesn't "
        "choose what is imported. If you trust it, give the sweep's YAML file that declares it, "
        "or its id, as --env (load_policy: env=...)"
    )


def _floats(array: NDArray[Any]) -> Floats:
    return np.ascontiguousarray(array, np.float32)


# -- finding a policy ------------------------------------------------------------------------------


def find_policy(wanted: str, storage: str) -> str:
    """The place from which `load_policy` loads a run's policy.

    Args:
        wanted: A place (folder, file, URI), which is returned as it is; the key of a run or its
            beginning; or a run's label or enough parts of it (`q=1.5/seed0`).
        storage: Folder or URI in which keys and labels are looked up.

    Returns:
        The folder of a finished run, or the newest checkpoint of an unfinished one.

    Raises:
        PolicyError: No run matches, or several do; the message lists them.
    """
    if not wanted:
        raise PolicyError("the run must not be empty, got ''")
    if not storage:  # a Path of '' would be the current folder
        raise PolicyError("--storage must not be empty, got ''")
    if "://" in wanted or wanted.startswith(("models:/", "runs:/")) or os.path.lexists(wanted):
        return wanted
    storage = resolve_storage(storage)[0]
    try:
        return _find(wanted, storage)
    except OSError as error:
        raise PolicyError(
            f"--storage must be a place that can be read, got {redact(storage)}: {error}"
        ) from error


def _find(wanted: str, storage: str) -> str:
    root = open_storage(storage)
    labels: dict[str, list[str]] = {}
    for key, label in _labels(root):
        labels.setdefault(key, []).append(label)  # sweeps that share a run label it differently
    nodes = SealedFolders(root / "nodes")
    finished = nodes.names()
    unfinished = [key for key in sorted((root / "work").folders()) if key not in finished]
    keys = _matching(wanted, [*finished, *unfinished], labels)
    if not keys:
        known = [labels.get(key, [key])[0] for key in finished][:_LISTED]
        there = f"finished there: {', '.join(known)}" if known else "no run is finished there"
        raise PolicyError(
            f"{wanted!r} must be a folder, or the key or label of a run in {storage}; {there}"
        )
    if len(keys) > 1:
        fits = [f"{labels[key][0]} ({key[:8]})" if key in labels else key for key in keys[:_LISTED]]
        more = f" and {len(keys) - _LISTED} more" if len(keys) > _LISTED else ""
        raise PolicyError(
            f"{wanted!r} must match one run, it matches {', '.join(fits)}{more}; give more of the "
            "label, or the key"
        )
    if keys[0] in finished:
        return below(storage, f"nodes/{keys[0]}")
    checkpoints = SealedFolders(root / "work" / keys[0]).names()
    if not checkpoints:
        raise PolicyError(f"{wanted!r} must have a checkpoint, it has none in {storage} yet")
    return below(storage, f"work/{keys[0]}/{checkpoints[-1]}")


def named_environment(env: str | None) -> str | tuple[Task, ...]:
    """The environment of `--env` for `load_policy`: an id, or the tasks of a sweep's YAML file.

    Raises:
        ConfigError: The file can't be read, or is wrong.
    """
    if env is None:
        return ()
    return declared_tasks(env) if env.endswith((".yaml", ".yml")) else env


def _matching(wanted: str, keys: list[str], labels: dict[str, list[str]]) -> list[str]:
    by_label = [key for key in keys if wanted in labels.get(key, ())]
    if by_label:
        return by_label
    if wanted in keys:
        return [wanted]
    by_prefix = [key for key in keys if key.startswith(wanted)]
    if len(wanted) >= _SHORTEST_KEY and by_prefix:
        return by_prefix
    return [key for key in keys if any(label_matches(wanted, one) for one in labels.get(key, ()))]


def _labels(storage: StorageFolder) -> Iterator[tuple[str, str]]:
    """Key and label of every run in the plans of the storage's sweeps."""
    for name in sorted(storage.having("plan.json", storage.folders())):
        try:
            nodes = json.loads((storage / name).read("plan.json") or b"")["nodes"]
            labels = [(str(node["key"]), str(node["label"])) for node in nodes]
        except (ValueError, TypeError, LookupError, RecursionError) as error:
            plan = f"{storage.path}/{name}/plan.json"
            warnings.warn(f"{plan} is damaged, its labels are unknown: {error!r}", stacklevel=2)
            continue
        yield from labels
