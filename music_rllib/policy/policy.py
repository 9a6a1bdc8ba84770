"""Loads a run's policy from any place that holds it, without Ray and without unpickling."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from music_rllib.config.problems import shown
from music_rllib.envs.make import Known, known_environment
from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError
from music_rllib.limits import MOST_WEIGHTS_BYTES
from music_rllib.policy.network import Floats, PolicyFileError, PolicyNetwork
from music_rllib.store.handoff import MANIFEST as HANDOFF_FILE
from music_rllib.store.handoff import (
    HandoffError,
    HandoffInfo,
    open_handoff,
    read_handoff,
)
from music_rllib.store.sealed import MANIFEST, SealedFolders
from music_rllib.store.storage import StorageError, database_url, open_storage

MLFLOW_FILE = "policy.safetensors"
"""File with the policy in an MLflow model."""
_LISTED = 8
"""Sub-folders that a message lists."""


class PolicyError(BadInputError, ValueError):
    """A policy can't be loaded; the message names the place and the reason."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """The deterministic policy of a run, and the task and settings it was trained with."""

    network: PolicyNetwork
    task: Task
    variant: str
    seed: int
    node_key: str
    env_steps: int
    """Environment steps of its training."""
    max_episode_steps: int
    """Steps after which its episodes are truncated."""
    environment: Known | None
    """The environment of its episodes. None where only the policy's file names it, and neither
    this package nor the user does: the policy acts, but no environment is imported."""

    @property
    def observation_size(self) -> int:
        """Features of an observation, without goals."""
        return self.network.observation_size

    @property
    def goal_size(self) -> int:
        """Features of a goal; 0 where the task has none."""
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
        """The action in the environment's own units, float32 (see `PolicyNetwork.act`)."""
        return self.network.act(observation)

    def to_bytes(self) -> bytes:
        """The content of a policy's file, which `load_policy` reads."""
        return self.network.to_bytes()


def load_policy(place: str | Path, env: str | Sequence[Task] = ()) -> Policy:
    """Loads the policy of a finished or unfinished run.

    Nothing that its files name is imported or executed.

    Args:
        place: a folder, or an `s3://` or `gs://` URI, of a finished node (`nodes/KEY`), of a
            checkpoint (`work/KEY/NUMBER`) or of a handoff; a policy's own file; or an MLflow URI
            (`models:/...`, `runs:/...`).
        env: the environment of its episodes, where it isn't one of the built-in tasks or of
            Gymnasium: its id (`module:` in front is imported), or tasks that declare it, as
            `config.load.declared_tasks` reads them from a sweep's YAML file.

    Raises:
        PolicyError: there is no policy, or it is damaged; the message names the place.
    """
    text = str(place)
    try:
        if text.startswith(("models:/", "runs:/")):
            return _from_mlflow(text, env)
        with _local_copy(text) as found:
            return (_from_file if found.is_file() else policy_from_folder)(found, env)
    except (HandoffError, StorageError, PolicyFileError, OSError) as error:
        raise PolicyError(f"{text} must hold a policy: {error}") from error


def policy_from_folder(folder: Path, env: str | Sequence[Task] = ()) -> Policy:
    """The policy in a local node, checkpoint, handoff or MLflow model; `env` as for `load_policy`.

    Raises:
        PolicyError: the weights don't fit their task or settings, or sub-folders hold several
            policies.
        HandoffError: there are no weights.
    """
    for inside in (MLFLOW_FILE, f"artifacts/{MLFLOW_FILE}"):
        # A handoff's own file of weights has the same name.
        if (folder / inside).is_file() and not (folder / HANDOFF_FILE).is_file():
            return _from_file(folder / inside, env)
    try:
        handoff_parent, manifest = open_handoff(folder)
    except HandoffError as error:
        raise _several_policies(folder) or error from None
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


def _several_policies(folder: Path) -> PolicyError | None:
    """The error for a folder that has policies in its sub-folders only; None for any other.

    `best` writes such a folder where a sweep has several tasks.
    """
    if (folder / "handoff").exists() or (folder / HANDOFF_FILE).exists():
        return None  # the error of this handoff is the one to report
    policies = []
    for child in sorted(folder.glob("*/")):
        with contextlib.suppress(HandoffError):
            policies.append(f"{child} ({open_handoff(child)[1].info.task.name})")
    if not policies:
        return None
    more = f" and {len(policies) - _LISTED} more" if len(policies) > _LISTED else ""
    return PolicyError(
        f"{folder} must hold one policy, its sub-folders hold one each: give "
        f"{' or '.join(policies[:_LISTED])}{more}"
    )


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
            f"{uri} must be a model at {mlflow.get_tracking_uri()} (MLFLOW_TRACKING_URI): {error}"
        ) from error


@contextlib.contextmanager
def _local_copy(place: str) -> Iterator[Path]:
    """Yields a verified copy of an object folder, or any other local folder or file itself."""
    storage = open_storage(place)
    parent, _, name = storage.path.rpartition("/")
    folders = SealedFolders(replace(storage, path=parent))
    if not folders.exists(name):
        if storage.is_local:
            yield Path(storage.path)
            return
        raise PolicyError(f"{place} must be a finished node or a checkpoint: no {MANIFEST} there")
    with TemporaryDirectory() as folder:
        sizes = {file: entry.bytes for file, entry in folders.manifest(name).files.items()}
        needed = {file for file in sizes if file in _FILES or file.startswith("handoff/")}
        total = sum(sizes[file] for file in needed)
        if total > MOST_WEIGHTS_BYTES:
            raise PolicyError(
                f"{place} must have at most {MOST_WEIGHTS_BYTES} bytes of weights, it has {total}"
            )
        folders.fetch(name, Path(folder), needed.__contains__)
        yield Path(folder)


_FILES = {HANDOFF_FILE, MLFLOW_FILE, f"artifacts/{MLFLOW_FILE}"}


def unknown_environment(task: Task) -> str:
    """The message that a task's environment is not made, and how to have it made."""
    arguments = f" with {shown(task.env_kwargs)}" if task.env_kwargs else ""
    return (
        f"the environment of {task.name} must be a built-in task's, one of Gymnasium's, or named "
        f"by you: the policy's file names {shown(task.env_id)}{arguments}, and a file doesn't "
        "choose what is imported. If you trust it, give the sweep's YAML file that declares it, "
        "or its id, as --env (load_policy: env=...)"
    )


def _floats(array: NDArray[Any]) -> Floats:
    return np.ascontiguousarray(array, np.float32)
