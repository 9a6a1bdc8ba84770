"""Loading a run's policy from where the run left it, without Ray and without unpickling."""

from __future__ import annotations

import contextlib
import functools
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pyarrow.fs as pafs
from numpy.typing import NDArray
from pydantic import ValidationError

from music_rllib.envs.make import check_action_space, make_env, observation_sizes
from music_rllib.envs.registry import Task
from music_rllib.experiment.handoff import MANIFEST as HANDOFF_FILE
from music_rllib.experiment.handoff import HandoffError, HandoffInfo, open_handoff, read_handoff
from music_rllib.experiment.sealed import MANIFEST, SealedFolders, StorageError, open_storage
from music_rllib.experiment.settings import RunSettings
from music_rllib.policy.network import Floats, PolicyFileError, PolicyNetwork
from music_rllib.tac.settings import TACSettings

__all__ = ["RUN_FILE", "Policy", "PolicyError", "load_policy", "policy_from_folder"]

RUN_FILE = "run.json"
"""A run's settings, in its node and in its checkpoints."""
MLFLOW_FILE = "policy.safetensors"
"""The policy in an MLflow model."""
NAMED = 8
"""Sub-folders that a message lists."""


class PolicyError(ValueError):
    """A policy that can't be loaded; says from where and why."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """The deterministic policy of a run, and what it was trained for."""

    network: PolicyNetwork
    task: Task
    variant: str
    seed: int
    node_key: str
    env_steps: int
    """Environment steps that it was trained for."""
    max_episode_steps: int
    """Steps of its episodes."""

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
        """The action in the environment's own units, float32 (see `PolicyNetwork.act`).

        Raises:
            ValueError: the observation isn't one of the task.
        """
        return self.network.act(observation)

    def to_bytes(self) -> bytes:
        """One file with all of it; `load_policy` reads it."""
        return self.network.to_bytes()


def load_policy(place: str | Path) -> Policy:
    """Load the policy of a finished or unfinished run.

    Args:
        place: a folder, or an `s3://` or `gs://` URI, of a finished node (`nodes/KEY`), of a
            checkpoint (`work/KEY/NUMBER`) or of a handoff; a policy's own file; or an MLflow URI
            (`models:/...`, `runs:/...`).

    Raises:
        PolicyError: nothing there is a policy, or it is damaged; names the place.
    """
    text = str(place)
    try:
        if text.startswith(("models:/", "runs:/")):
            return _from_mlflow(text)
        if "://" not in text and Path(text).is_file():
            return _from_file(Path(text))
        with _local_copy(text) as folder:
            return policy_from_folder(folder)
    except (HandoffError, StorageError, PolicyFileError, OSError) as error:
        raise PolicyError(f"{text} must hold a policy: {error}") from error


def policy_from_folder(folder: Path) -> Policy:
    """The policy in a local node, checkpoint or handoff, or in an MLflow model's folder.

    Raises:
        PolicyError: there are weights, but they don't belong to their task or settings, or there
            are several policies in sub-folders.
        HandoffError: there are none.
    """
    for inside in (MLFLOW_FILE, f"artifacts/{MLFLOW_FILE}"):
        if (folder / inside).is_file():
            return _from_file(folder / inside)
    try:
        above, manifest = open_handoff(folder)
    except HandoffError as error:
        raise _several(folder) or error from None
    info = manifest.info
    wanted = ["policy", "normaliser"] if info.architecture.normalise_observations else ["policy"]
    parts = read_handoff(above, wanted, info.task)
    run = _run_settings(folder / RUN_FILE)
    tac = run.tac if run else TACSettings()
    try:
        network = _network(parts, info, tac)
    except ValueError as error:
        raise PolicyError(f"{above} must fit the task {info.task.name}: {error}") from error
    return _policy(network)


def _several(folder: Path) -> PolicyError | None:
    """What to say of a folder with policies in its sub-folders only; None for another one.

    `best` leaves such a folder where a sweep has several tasks.
    """
    if (folder / "handoff").exists() or (folder / HANDOFF_FILE).exists():
        return None  # there is one, and the error says what is wrong with it
    found = []
    for below in sorted(folder.glob("*/")):
        with contextlib.suppress(HandoffError):
            found.append(f"{below} ({open_handoff(below)[1].info.task.name})")
    if not found:
        return None
    more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
    return PolicyError(
        f"{folder} must hold one policy, its sub-folders hold one each: give "
        f"{' or '.join(found[:NAMED])}{more}"
    )


def _network(
    parts: Mapping[str, Mapping[str, NDArray[Any]]], info: HandoffInfo, tac: TACSettings
) -> PolicyNetwork:
    bounds = _bounds(info.task.model_dump_json())
    policy = parts["policy"]
    # torch's names: the layers are every other entry of a Sequential.
    layers = sorted(int(name.removesuffix(".weight")) for name in policy if "weight" in name)
    features = policy[f"{layers[0]}.weight"].shape[1]
    if features != bounds.observation + bounds.goal:
        raise ValueError(
            f"the weights take {features} inputs, the environment's observations and goals have "
            f"{bounds.observation} and {bounds.goal}"
        )
    normaliser = parts.get("normaliser")
    limit = min(tac.max_episode_steps or info.task.horizon, info.task.horizon)
    return PolicyNetwork(
        weights=tuple(_floats(policy[f"{i}.weight"]) for i in layers),
        biases=tuple(_floats(policy[f"{i}.bias"]) for i in layers),
        mean=_floats(normaliser["mean"] if normaliser else np.zeros(features)),
        inverse_std=_floats(normaliser["inverse_std"] if normaliser else np.ones(features)),
        clip=tac.observation_clip if normaliser else float(np.finfo(np.float32).max),
        low=bounds.low,
        high=bounds.high,
        goal_size=bounds.goal,
        about={**info.model_dump(mode="json"), "max_episode_steps": limit},
    )


def _policy(network: PolicyNetwork) -> Policy:
    about = network.about
    return Policy(
        network=network,
        task=Task.model_validate(about["task"]),
        variant=str(about["variant"]),
        seed=int(about["seed"]),
        node_key=str(about["node_key"]),
        env_steps=int(about["env_steps"]),
        max_episode_steps=int(about["max_episode_steps"]),
    )


def _from_file(path: Path) -> Policy:
    try:
        return _policy(PolicyNetwork.from_file(path))
    except (KeyError, TypeError, ValidationError) as error:
        raise PolicyError(f"{path} must say what it was trained for: {error}") from error


def _from_mlflow(uri: str) -> Policy:
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    import mlflow
    from mlflow.exceptions import MlflowException

    try:
        with TemporaryDirectory() as folder:
            model = mlflow.artifacts.download_artifacts(uri, dst_path=folder)
            return policy_from_folder(Path(model))
    except MlflowException as error:
        raise PolicyError(
            f"{uri} must be a model at {mlflow.get_tracking_uri()} (MLFLOW_TRACKING_URI): {error}"
        ) from error


@contextlib.contextmanager
def _local_copy(place: str) -> Iterator[Path]:
    """A sealed folder's verified copy; another local folder as it is."""
    filesystem, root = open_storage(place)
    above, _, name = root.rpartition("/")
    sealed = SealedFolders(filesystem, above)
    if not sealed.exists(name):
        if isinstance(filesystem, pafs.LocalFileSystem):
            yield Path(root)
            return
        raise PolicyError(f"{place} must be a finished node or a checkpoint: no {MANIFEST} there")
    with TemporaryDirectory() as folder:
        sealed.fetch(name, Path(folder))
        yield Path(folder)


def _run_settings(path: Path) -> RunSettings | None:
    """A run's settings; None for a handoff that came alone."""
    if not path.is_file():
        return None
    try:
        return RunSettings.model_validate(json.loads(path.read_text()))
    except ValueError as error:
        raise PolicyError(f"{path} must hold a run's settings: {error}") from error


class _Bounds(NamedTuple):
    observation: int
    goal: int
    low: Floats
    high: Floats


@functools.cache
def _bounds(task: str) -> _Bounds:
    """Sizes and action bounds of a task (its JSON), asked of the environment once."""
    described = Task.model_validate_json(task)
    try:
        env = make_env(described.env_id, **described.env_kwargs)
    except (gym.error.Error, ImportError) as error:
        raise PolicyError(
            f"{described.name}: the environment {described.env_id} must be there: {error}"
        ) from error
    try:
        actions = check_action_space(env.action_space)
        sizes = observation_sizes(env.observation_space)
        return _Bounds(*sizes, _floats(actions.low), _floats(actions.high))
    finally:
        env.close()


def _floats(array: NDArray[Any]) -> Floats:
    return np.ascontiguousarray(array, np.float32)
