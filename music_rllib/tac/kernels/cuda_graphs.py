"""Gradient updates captured as CUDA graphs.

An update of 256 transitions is some hundred small kernels, and Python takes longer to launch them
than a GPU to run them. A graph of all of them is launched at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

__all__ = ["CapturedUpdate", "CudaRecorder", "Recorder", "Replay", "UpdateConstants"]

logger = logging.getLogger(__name__)

WARM_UP = 3
"""Updates before one is captured: in their first ones libraries and optimizers allocate."""
KEPT = 2
"""Captures that are kept; a schedule makes a new one for each of its values."""
Tensors = Mapping[Any, Tensor]
Key = TypeVar("Key", bound=Hashable)
Replay = Callable[[], None]


class UpdateConstants(NamedTuple):
    """What an update depends on and what is no tensor: captured, it stays as it was."""

    entropic_index: float
    mi_reward_weight: float
    alpha: float | None
    """None: learned, and a tensor."""
    drawn: Hashable
    """By the intrinsic reward, for this update."""
    trajectories: tuple[int, bool] | None
    """Frames of the trajectories that are learned from, and whether some are shorter."""


class Recorder(Protocol):
    """What captures kernels and repeats them."""

    def warm_up(self, function: Callable[[], Tensors]) -> Tensors:
        """Run `function` as it will be captured."""

    def record(self, function: Callable[[], Tensors]) -> tuple[Tensors, Replay]:
        """Capture the kernels of `function`, which are not run.

        Returns:
            What it returned, whose memory each replay writes to, and what replays it.

        Raises:
            RuntimeError: something in it can't be captured.
        """


class CapturedUpdate(Generic[Key]):
    """An update whose kernels are captured, once for each key, and repeated from then on.

    What is captured reads its inputs where they were, so the inputs of later calls are copied
    there; numbers that Python has put into it stay as they were, so they belong into the key.

    Args:
        update: takes tensors and a key, returns tensors. All of these and its state are on the
            device, and it never waits for the device.
        recorder: what captures it.
    """

    def __init__(self, update: Callable[[Tensors, Key], Tensors], recorder: Recorder) -> None:
        self._update = update
        self._recorder = recorder
        self._captures: dict[Key, _Capture] = {}
        self._gave_up = False

    def __call__(self, inputs: Tensors, key: Key) -> Tensors:
        """The update's outputs.

        Args:
            inputs: of the same names and shapes in each call with the same key.
            key: everything that the update depends on and that is no tensor.
        """
        if self._gave_up:
            return self._update(inputs, key)
        if key not in self._captures:
            if len(self._captures) == KEPT:
                del self._captures[next(iter(self._captures))]
            self._captures[key] = _Capture(lambda held: self._update(held, key), self._recorder)
        try:
            return self._captures[key](inputs)
        except _NotCapturedError as error:
            logger.warning(
                "updates are not captured as a CUDA graph, which costs speed: %s", error.__cause__
            )
            self._gave_up = True
            self.forget()
            return self._update(inputs, key)

    def forget(self) -> None:
        """Capture anew: tensors that the update reads or writes have been replaced."""
        self._captures.clear()


class _NotCapturedError(RuntimeError):
    """The cause says why."""


class _Capture:
    """The captured kernels of one key."""

    def __init__(self, update: Callable[[Tensors], Tensors], recorder: Recorder) -> None:
        self._update, self._recorder = update, recorder
        self._calls = 0
        self._inputs: dict[Any, Tensor] = {}
        self._outputs: Tensors = {}
        self._replay: Replay | None = None

    def __call__(self, inputs: Tensors) -> Tensors:
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._recorder.warm_up(lambda: self._update(inputs))
        replay = self._replay or self._record(inputs)
        torch._foreach_copy_(list(self._inputs.values()), [inputs[name] for name in self._inputs])
        replay()
        return {name: values.clone() for name, values in self._outputs.items()}

    def _record(self, inputs: Tensors) -> Replay:
        self._inputs = {name: values.clone() for name, values in inputs.items()}
        try:
            self._outputs, self._replay = self._recorder.record(lambda: self._update(self._inputs))
        except RuntimeError as error:
            raise _NotCapturedError from error
        return self._replay


class CudaRecorder:
    """CUDA's own graphs; all share a pool of memory, since one runs at a time."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    def warm_up(self, function: Callable[[], Tensors]) -> Tensors:
        """Runs it on the stream of the captures, where autograd then finds its nodes."""
        current = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            outputs = function()
        current.wait_stream(self._stream)
        return outputs

    def record(self, function: Callable[[], Tensors]) -> tuple[Tensors, Replay]:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, stream=self._stream):
            outputs = function()
        return outputs, graph.replay
