"""Handoffs: the network weights that one run takes over from another, with a manifest.

A handoff is a folder with one safetensors file per network and `handoff.json`, which names the
task, the source run, and the size, hash and shapes of each file. The manifest is written last and
read first. A handoff cannot contain code: a pickle in place of weights has the wrong hash, and if
the manifest was forged too, it is not a safetensors file.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from music_rllib.envs.tasks import Task
from music_rllib.errors import BadInputError, reason_of
from music_rllib.limits import (
    MOST_JSON_BYTES,
    MOST_WEIGHTS_BYTES,
    read_json,
    read_regular,
)
from music_rllib.schedules import StrictModel
from music_rllib.store.files import write_atomically
from music_rllib.store.serialization import arrays_from_bytes, arrays_to_bytes, content_key
from music_rllib.version import ALGORITHM_VERSION

if TYPE_CHECKING:
    import gymnasium as gym

NetworkWeights = Mapping[str, Mapping[str, npt.NDArray[Any]]]
"""Arrays by network and array name."""

MANIFEST = "handoff.json"


class HandoffError(BadInputError, ValueError):
    """A handoff is missing, damaged or does not fit; the message says which and why."""


class Architecture(StrictModel):
    """The settings that determine the shapes and the meaning of network weights."""

    hidden_sizes: tuple[int, ...]
    layer_norm: str = "none"
    critics: int | None = None
    """None: the default of the policy."""
    quantiles: int = 0
    policy: str
    bootstrap: str
    normalise_observations: bool
    estimator_hidden_size: int
    estimator_bound: str = "capped"
    log_std_form: str
    """Meaning of the policy's outputs."""
    log_std_bounds: tuple[float, float] | None
    """Range to which the form `tanh` scales; other forms only clip to it."""
    intrinsic: str | None = None
    """An intrinsic reward and its settings."""

    def differences(self, other: Architecture, starts_from: str) -> list[str]:
        """Settings that prevent a run from starting from these weights, named as in YAML."""
        if starts_from == "estimator":
            prefix, known = "estimator_", ("estimator_hidden_size", "estimator_bound")
            wrong = (name for name in known if getattr(self, name) != getattr(other, name))
            return [f"music.{name.removeprefix(prefix)}" for name in wrong]
        if starts_from == "intrinsic":
            names = ["intrinsic.reward and intrinsic.settings"]
            return [] if self.intrinsic == other.intrinsic else names
        fields = ["hidden_sizes", "layer_norm", "policy", "bootstrap", "normalise_observations"]
        fields += ["critics", "quantiles", "log_std_form"]
        if self.log_std_form == other.log_std_form:
            fields.append("log_std_bounds")
        mine, theirs = (
            one.model_copy(update={"critics": one.critics or 2 - (one.policy == "deterministic")})
            for one in (self, other)
        )
        return [f"tac.{name}" for name in fields if getattr(mine, name) != getattr(theirs, name)]


class Spaces(StrictModel):
    """The sizes and bounds of an environment's spaces that a policy needs to act."""

    observation_size: int = Field(gt=0)
    goal_size: int = Field(ge=0)
    action_low: tuple[float, ...] = Field(min_length=1)
    action_high: tuple[float, ...]

    @classmethod
    def of(cls, observations: gym.Space[Any], actions: gym.Space[Any]) -> Spaces:
        """The sizes and bounds of these spaces.

        Raises:
            ValueError: Training does not support these spaces.
        """
        from music_rllib.envs.values import check_action_space, observation_sizes

        observation_size, goal_size = observation_sizes(observations)
        bounds = check_action_space(actions)
        return cls(
            observation_size=observation_size,
            goal_size=goal_size,
            action_low=tuple(bounds.low.tolist()),
            action_high=tuple(bounds.high.tolist()),
        )


class HandoffInfo(StrictModel):
    """The run that a handoff comes from."""

    task: Task
    variant: str
    architecture: Architecture
    env_steps: int
    seed: int
    node_key: str
    algorithm_version: str = ALGORITHM_VERSION
    spaces: Spaces
    observation_clip: float
    max_episode_steps: int | None


_REWARD = "intrinsic"
"""The networks of an intrinsic reward."""


class _Array(StrictModel):
    shape: tuple[int, ...]
    dtype: str


class _ModuleFile(StrictModel):
    file: Annotated[str, Field(pattern=r"^[a-z_]+\.safetensors$")]
    """Name in the manifest's folder; a forged manifest cannot name another place."""
    sha256: str
    bytes: int
    arrays: dict[str, _Array]


class HandoffManifest(StrictModel):
    """Content of `handoff.json`."""

    format: Literal["music_rllib handoff 1"] = "music_rllib handoff 1"
    info: HandoffInfo
    modules: dict[str, _ModuleFile]

    @property
    def content_hash(self) -> str:
        """Hash of everything in the handoff that affects a run that starts from it."""
        weights = {name: module.sha256 for name, module in self.modules.items()}
        return content_key({"task": self.info.task.identity(), "modules": weights})


def write_handoff(folder: Path, weights: NetworkWeights, info: HandoffInfo) -> HandoffManifest:
    """Write network weights and their manifest into `folder`.

    Raises:
        ValueError: An array contains NaN or infinity: the run diverged, and no run may start from
            it.
        OSError: The folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, arrays in weights.items():
        for key, array in arrays.items():
            # A reward's buffer may hold infinity. If its parameters did, so would the policy's.
            if name != _REWARD and not np.isfinite(array).all():
                raise ValueError(f"{name}.{key} must be finite to start a run from it, it is not")
        data = arrays_to_bytes(arrays)
        file = f"{name}.safetensors"
        write_atomically(folder / file, data)
        files[name] = _ModuleFile(
            file=file,
            sha256=hashlib.sha256(data).hexdigest(),
            bytes=len(data),
            arrays=_descriptions(arrays),
        )
    manifest = HandoffManifest(info=info, modules=files)
    write_atomically(folder / MANIFEST, manifest.model_dump_json(indent=1).encode())
    return manifest


def _descriptions(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, _Array]:
    return {key: _Array(shape=a.shape, dtype=str(a.dtype)) for key, a in arrays.items()}


def open_handoff(folder: Path) -> tuple[Path, HandoffManifest]:
    """The folder and the manifest of a handoff in `folder`, or in its folder `handoff/`.

    Raises:
        HandoffError: The handoff does not exist, or its manifest is not valid.
    """
    for candidate in (folder, folder / "handoff", *_in_uploaded_node(folder)):
        path = candidate / MANIFEST
        if path.is_file():
            try:
                content = read_json(read_regular(path, MOST_JSON_BYTES))
                return candidate, HandoffManifest.model_validate(content)
            except (ValueError, OSError) as error:
                raise HandoffError(
                    f"{path} must be a handoff manifest: {reason_of(error)}"
                ) from None
    found = "the folder exists" if folder.is_dir() else "the folder does not exist"
    raise HandoffError(f"{folder} must hold a handoff ({MANIFEST} and weights): {found}")


def _in_uploaded_node(folder: Path) -> list[Path]:
    """The handoff in a copy of a node of a bucket, whose files are below a prefix."""
    from music_rllib.store.sealed import MANIFEST as SEALED
    from music_rllib.store.sealed import Manifest

    with contextlib.suppress(OSError, ValueError):
        sealed = Manifest.model_validate(read_json(read_regular(folder / SEALED, MOST_JSON_BYTES)))
        return [folder / sealed.prefix / "handoff"]
    return []


def read_handoff(
    folder: Path, networks: Sequence[str], task: Task
) -> dict[str, dict[str, npt.NDArray[Any]]]:
    """Read and verify the weights of `networks`, which must have been trained on `task`.

    The name of the task may differ. `folder` is as for `open_handoff`.

    Raises:
        HandoffError: A network is missing, damaged, or was trained on another task.
    """
    folder, manifest = open_handoff(folder)
    _check_task(folder, manifest.info.task, task)
    absent = [name for name in networks if name not in manifest.modules]
    if absent:
        raise HandoffError(
            f"{folder} must have {', '.join(networks)}; it lacks {', '.join(absent)} "
            f"(trained with {manifest.info.variant})"
        )
    return {name: _read_weights(folder, manifest.modules[name]) for name in networks}


def task_differences(source: Task, task: Task) -> list[str]:
    """The differences of a handoff's task from the one that is wanted, in words."""
    theirs, ours = (one.identity() | {"seed_range": one.seed_range} for one in (source, task))
    return [
        f"{key} is {json.dumps(theirs[key])} there and {json.dumps(ours[key])} here"
        for key in ours
        if theirs[key] != ours[key]
    ]


def _check_task(folder: Path, source: Task, task: Task) -> None:
    if differences := task_differences(source, task):
        raise HandoffError(
            f"{folder} must be of task {task.name}, it is of {source.name}: "
            + "; ".join(differences)
        )


def _read_weights(folder: Path, expected: _ModuleFile) -> dict[str, npt.NDArray[Any]]:
    path = folder / expected.file
    try:
        data = read_regular(path, min(expected.bytes, MOST_WEIGHTS_BYTES))
    except OSError as error:
        raise HandoffError(f"{path} must be readable: {error.strerror}") from None
    if len(data) != expected.bytes:
        raise HandoffError(f"{path} must have {expected.bytes} bytes, it has {len(data)}")
    if hashlib.sha256(data).hexdigest() != expected.sha256:
        raise HandoffError(f"{path} must have the hash in {MANIFEST}, its content has changed")
    try:
        arrays = arrays_from_bytes(data)
    except ValueError as error:
        raise HandoffError(f"{path} must be a safetensors file: {error}") from None
    found = _descriptions(arrays)
    keys = found.keys() | expected.arrays.keys()
    wrong = sorted(key for key in keys if found.get(key) != expected.arrays.get(key))
    if wrong:
        raise HandoffError(f"{path} must have the arrays in {MANIFEST}; wrong: {', '.join(wrong)}")
    return arrays
