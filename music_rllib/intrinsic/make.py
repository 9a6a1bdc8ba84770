"""Makes an intrinsic reward from its name and settings."""

from __future__ import annotations

import importlib
import inspect

import torch

from music_rllib.envs.tasks import make_importable
from music_rllib.intrinsic.interface import IntrinsicReward, Sizes
from music_rllib.intrinsic.settings import BUILT_IN, IntrinsicSettings


def reward_class(name: str) -> type[IntrinsicReward]:
    """The class of a built-in reward, or of a user's `module:Class`, whose module is imported.

    Raises:
        ValueError: The module cannot be imported, or has no such class.
    """
    module, _, attribute = BUILT_IN.get(name, name).partition(":")
    try:
        if name not in BUILT_IN:
            make_importable(module)
        found = getattr(importlib.import_module(module), attribute, None)
    except ImportError as error:
        raise ValueError(f"intrinsic.reward must be importable, got {name!r}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, IntrinsicReward)):
        raise ValueError(
            f"intrinsic.reward must name a subclass of IntrinsicReward in {module}, got {name!r}"
        )
    if inspect.isabstract(found):
        raise ValueError(f"intrinsic.reward must have a method bonus, which {name} lacks")
    return found


def checked_class(settings: IntrinsicSettings) -> type[IntrinsicReward]:
    """The class of a reward whose settings fit its constructor.

    Raises:
        ValueError: As `reward_class`, or the settings do not fit.
    """
    assert settings.reward is not None
    kind = reward_class(settings.reward)
    try:
        inspect.signature(kind).bind(None, **settings.settings)
    except TypeError as error:
        raise ValueError(f"intrinsic.settings must fit {settings.reward}: {error}") from error
    return kind


def make_reward(
    settings: IntrinsicSettings, sizes: Sizes, seed: int, device: torch.device | None = None
) -> IntrinsicReward:
    """A reward on a device, with initial weights that depend on the seed only.

    Raises:
        ValueError: The class, its settings or the environment do not fit.
    """
    kind = checked_class(settings)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reward = kind(sizes, **settings.settings)
    if getattr(reward, "sums", None) is None:
        raise ValueError(f"{settings.reward} must call super().__init__(sizes) in its __init__")
    return reward.to(device)
