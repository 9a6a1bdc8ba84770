"""Play an environment beside a second one in the same process, as training does."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np


class Beside(gym.Wrapper[Any, Any, Any, Any]):
    """An environment; each of its steps follows one of a second environment.

    Args:
        env: the environment.
        second: the other one.
        seed: seed of the second environment's episodes.
        generators: whether they share the global random generators of NumPy, PyTorch and Python.
    """

    def __init__(
        self, env: gym.Env[Any, Any], second: gym.Env[Any, Any], seed: int, *, generators: bool
    ) -> None:
        super().__init__(env)
        self._second, self._seed = second, seed
        self._between = contextlib.nullcontext if generators else _kept_generators

    def reset(self, **options: Any) -> Any:
        """Reset both, the second environment last."""
        found = self.env.reset(**options)
        with self._between():
            self._second.reset(seed=self._seed)
        return found

    def step(self, action: Any) -> Any:
        """Take the step in both, in the second environment first."""
        with self._between():
            _, _, terminated, truncated, _ = self._second.step(np.array(action))
            if terminated or truncated:
                self._second.reset(seed=self._seed)
        return self.env.step(action)


@contextlib.contextmanager
def _kept_generators() -> Iterator[None]:
    """Restore the global random generators afterwards."""
    numpy_state, state = np.random.get_state(), random.getstate()  # noqa: NPY002
    torch = sys.modules.get("torch")
    torch_state = torch.get_rng_state() if torch else None
    try:
        yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(state)
        if torch:
            torch.set_rng_state(torch_state)
