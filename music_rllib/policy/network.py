"""A trained policy as plain arrays: from observations to actions, in numpy.

Shape legend: B batch, O observation features, G goal features (0 without goals), I = O + G,
A action dimensions.

This file stands alone (numpy and safetensors): it is copied into the MLflow models of policies,
which therefore act where nothing else of this package is installed. A policy is one safetensors
file: its arrays, and in its header a JSON text about them. Reading it can't execute anything.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors
from safetensors.numpy import save as save_safetensors

FORMAT = "music_rllib policy 1"
LAYER_NORM_FORMAT = "music_rllib policy 2"
"""The format of policies with layer normalization, which older versions must not read."""
LAYER_NORM_EPSILON = 1e-5
"""Added to the variance in layer normalization, as in training."""
MOST_HEADER_BYTES = 1 << 20
"""Largest header of a policy's file, which may come from anywhere; ours have a few thousand."""
_HEADER = "music_rllib_policy"
MOST_BOUND = 1e15
"""Largest bound of an action, as in training: the range of larger ones may exceed float32."""

Floats = npt.NDArray[np.float32]


class PolicyFileError(ValueError):
    """A file is not a policy; the message names the file and the reason."""


@dataclass(frozen=True, kw_only=True)
class PolicyNetwork:
    """A deterministic policy: normalizer, perceptron, tanh, the environment's bounds."""

    weights: tuple[Floats, ...]
    """[outputs, inputs] of each layer, as torch keeps them."""
    biases: tuple[Floats, ...]
    """[outputs] of each layer; the last has A, or 2 A of which the first half are means."""
    mean: Floats
    """[I] subtracted from the inputs."""
    inverse_std: Floats
    """[I] factor on the shifted inputs."""
    clip: float
    """Normalized inputs are clipped to plus/minus this."""
    low: Floats
    """[A] the environment's lowest actions."""
    high: Floats
    """[A] the environment's highest actions."""
    goal_size: int
    """G, 0 for an environment without goals."""
    layer_norm: bool = False
    """Whether the outputs of each hidden layer are normalized before ReLU."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The run that it comes from, as JSON values; they do not influence actions."""

    def __post_init__(self) -> None:
        """Raise ValueError if the arrays do not fit together."""
        sizes = [self.input_size, *(len(bias) for bias in self.biases)]
        shapes = [(out, into) for into, out in pairwise(sizes)]
        if not self.weights or [weight.shape for weight in self.weights] != shapes:
            raise ValueError(
                f"a policy's layers must fit together, got weights of "
                f"{[weight.shape for weight in self.weights]} for sizes {sizes}"
            )
        if sizes[-1] not in (self.action_size, 2 * self.action_size):
            raise ValueError(
                f"a policy's last layer must have {self.action_size} or {2 * self.action_size} "
                f"outputs for {self.action_size} actions, got {sizes[-1]}"
            )
        vectors = (*self.biases, self.mean, self.inverse_std, self.low, self.high)
        if {array.ndim for array in vectors} != {1} or self.inverse_std.shape != self.mean.shape:
            raise ValueError("a policy's biases, normaliser and bounds must be vectors that fit")
        if not 0 <= self.goal_size < self.input_size or self.low.shape != self.high.shape:
            raise ValueError("a policy's goal must be a part of its inputs, its bounds of one size")
        if not (self.low <= self.high).all():
            raise ValueError("a policy's lowest actions must be below its highest ones")
        arrays = (*self.weights, *vectors)
        if not all(np.isfinite(array).all() for array in arrays):
            raise ValueError("a policy's arrays must be finite")
        largest = np.abs([self.low, self.high]).max(initial=0.0)
        if largest > MOST_BOUND:
            raise ValueError(
                f"a policy's actions must be within +-{MOST_BOUND:g}, got a bound of {largest:g}"
            )
        if not 0 < self.clip < np.inf:
            raise ValueError(f"a policy's inputs must be cut to a positive range, got {self.clip}")

    @property
    def input_size(self) -> int:
        """I, features of observation and goal."""
        return len(self.mean)

    @property
    def observation_size(self) -> int:
        """O, features of the observation alone."""
        return self.input_size - self.goal_size

    @property
    def action_size(self) -> int:
        """A, dimensions of an action."""
        return len(self.low)

    def act(self, observation: Any) -> Floats:
        """The deterministic action: [A], or [B, A] for a batch, within the environment's bounds.

        Args:
            observation: A dictionary with `observation` [O] and `desired_goal` [G] (more is
                ignored), or an array [I] of both side by side; or batches of them, [B, ...].

        Raises:
            ValueError: A part is missing, of another size, or not finite.
        """
        inputs = self._inputs(observation)
        hidden = np.clip((inputs - self.mean) * self.inverse_std, -self.clip, self.clip)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = hidden @ weight.T + bias
            if i < last:
                hidden = np.maximum(_normalized(hidden) if self.layer_norm else hidden, 0.0)
        action = np.tanh(hidden[..., : self.action_size])
        scaled = self.low + (action + 1.0) * 0.5 * (self.high - self.low)
        bounded: Floats = np.clip(scaled, self.low, self.high).astype(np.float32)
        return bounded

    def _inputs(self, observation: Any) -> Floats:
        if isinstance(observation, Mapping):
            parts = [self._part(observation, "observation", self.observation_size)]
            if self.goal_size:
                parts.append(self._part(observation, "desired_goal", self.goal_size))
            if len({part.shape[:-1] for part in parts}) > 1:
                raise ValueError(
                    "observation and desired_goal must be batches of one size, got shapes "
                    + " and ".join(str(part.shape) for part in parts)
                )
            return np.concatenate(parts, axis=-1)
        name = f"observation ({self.observation_size})"
        if self.goal_size:
            name += f" and desired_goal ({self.goal_size}) side by side"
        return _numbers(observation, name, self.input_size)

    def _part(self, observation: Mapping[str, Any], name: str, size: int) -> Floats:
        if name not in observation:
            raise ValueError(f"the observation must have {name!r}, it has {sorted(observation)}")
        return _numbers(observation[name], name, size)

    def to_bytes(self) -> bytes:
        arrays: dict[str, npt.NDArray[Any]] = {}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
        arrays |= {"normaliser.mean": self.mean, "normaliser.inverse_std": self.inverse_std}
        arrays |= {"action.low": self.low, "action.high": self.high}
        header = {
            "format": LAYER_NORM_FORMAT if self.layer_norm else FORMAT,
            "clip": self.clip,
            "goal_size": self.goal_size,
            "about": dict(self.about),
        }
        return save_safetensors(
            {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()},
            metadata={_HEADER: json.dumps(header)},
        )

    @classmethod
    def from_file(cls, path: Path) -> PolicyNetwork:
        """Read a file of `to_bytes`; raise PolicyFileError for any other file."""
        try:
            _check_file(path)
            with safetensors.safe_open(path, framework="numpy") as file:
                header = json.loads((file.metadata() or {}).get(_HEADER, "null"))
                names = list(file.keys())
                if {file.get_slice(name).get_dtype() for name in names} != {"F32"}:
                    raise ValueError("its arrays must be float32")
                arrays = {name: file.get_tensor(name) for name in names}
            formats = (FORMAT, LAYER_NORM_FORMAT)
            if not isinstance(header, dict) or header.get("format") not in formats:
                raise ValueError(f"its header must say {' or '.join(map(repr, formats))}")
            if not isinstance(header["about"], dict):
                raise ValueError("its header must say what it is about")
            count = sum(name.endswith(".bias") for name in arrays)
            return cls(
                weights=tuple(arrays[f"layer.{i}.weight"] for i in range(count)),
                biases=tuple(arrays[f"layer.{i}.bias"] for i in range(count)),
                mean=arrays["normaliser.mean"],
                inverse_std=arrays["normaliser.inverse_std"],
                clip=float(header["clip"]),
                low=arrays["action.low"],
                high=arrays["action.high"],
                goal_size=int(header["goal_size"]),
                layer_norm=header["format"] == LAYER_NORM_FORMAT,
                about=header["about"],
            )
        except _UNREADABLE as error:
            reason = f"it lacks {error}" if isinstance(error, KeyError) else error
            raise PolicyFileError(f"{path} must be a policy: {reason}") from None


def _normalized(hidden: Floats) -> Floats:
    """[..., H] with mean 0 and variance 1 in each row."""
    shifted = hidden - hidden.mean(-1, keepdims=True)
    normalized: Floats = shifted / np.sqrt(
        (shifted**2).mean(-1, keepdims=True) + LAYER_NORM_EPSILON
    )
    return normalized


_UNREADABLE = (
    *(OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError),
    safetensors.SafetensorError,
)


def _check_file(path: Path) -> None:
    """Raise ValueError, before anything is parsed, for a large header or not a regular file."""
    if not path.is_file():
        raise ValueError("it is not a regular file")
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
    if size > MOST_HEADER_BYTES:
        raise ValueError(f"its header must have at most {MOST_HEADER_BYTES} bytes, it says {size}")


def _numbers(values: Any, name: str, size: int) -> Floats:
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, got {type(values).__name__}") from None
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise ValueError(f"{name} must have shape [{size}] or [batch, {size}], got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, it is not")
    return array
