"""Captured updates against the same ones launched from Python: the same numbers.

A GPU is seldom at hand, so kernels are also captured on the CPU: what they were called with is
kept, and a replay calls them again, on the same memory and with the same numbers, which is what a
CUDA graph does.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from music_rllib.intrinsic.estimator import MutualInformationEstimator
from music_rllib.tac.algorithm import TAC
from music_rllib.tac.kernels.cuda_graphs import CapturedUpdate, CudaRecorder, Replay
from music_rllib.tac.learner import TACLearner
from tests.integration.test_tac_algorithm import (
    DDPG,
    HER,
    MUSIC_R,
    MUSIC_U,
    PER,
    build,
    fingerprint,
    register_uneven,
)

pytestmark = pytest.mark.usefixtures("local_ray")


@pytest.fixture(autouse=True)
def with_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU: the update without autograd is the CPU's own."""
    monkeypatch.setattr(TACLearner, "_is_standard", False)
    monkeypatch.setattr(MutualInformationEstimator, "compiled", False)


Function = Callable[[], Mapping[Any, Tensor]]
# Their results, or their arguments, depend on what the device has computed: reading that waits.
WAITING = {
    "_local_scalar_dense": "a number read on the host",
    "equal": "a comparison on the host",
    "lift_fresh": "a tensor made of a number on the host",
    "masked_select": "a shape that depends on values",
    "nonzero": "a shape that depends on values",
}


class Kernels(TorchDispatchMode):
    """Keeps each kernel that runs, with its arguments and results."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.calls: list[tuple[Any, Sequence[Any], dict[str, Any], Any]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        name = func.overloadpacket.__name__
        if name in WAITING:
            raise RuntimeError(f"{name}: {WAITING[name]}")
        results = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, results))
        return results

    def replay(self) -> None:
        with torch.no_grad():
            for func, args, kwargs, before in self.calls:
                results = func(*args, **kwargs)
                for old, new in zip(tree_leaves(before), tree_leaves(results), strict=True):
                    if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                        old.copy_(new)


class CpuRecorder:
    """Captures by running once, so the first replay has happened already."""

    def __init__(self) -> None:
        self.replays = 0

    def warm_up(self, function: Function) -> Mapping[Any, Tensor]:
        return function()

    def record(self, function: Function) -> tuple[Mapping[Any, Tensor], Replay]:
        with Kernels() as kernels:
            outputs = function()
        fresh = True

        def replay() -> None:
            nonlocal fresh
            self.replays += 1
            if not fresh:
                kernels.replay()
            fresh = False

        return outputs, replay


def captured(algo: TAC, recorder: Any) -> TAC:
    learner = algo.learner_group._learner
    learner._captured = CapturedUpdate(learner._step, recorder)
    return algo


RAMP = {"schedule": "linear", "start": 1.0, "end": 2.0}
BY_ENTROPY = {"follows": "shannon_entropy", "points": [[1.0, 1.0], [3.0, 2.0]]}
VARIANTS: dict[str, dict[str, Any]] = {
    "tac": HER,
    "music-u": {"music": MUSIC_U},
    "music-r": {"music": MUSIC_R, "entropic_index": 1.5},
    "episodes of unequal lengths": {"task": "Uneven", "music": MUSIC_U},
    "frames shuffled as in 2021": {"music": {**MUSIC_U, "shuffle": "random"}},
    "q measured, alpha scheduled": {"entropic_index": BY_ENTROPY, "alpha": {**RAMP, "start": 0.1}},
    "alpha learned": {"alpha": {"learned": True}, "bootstrap": "critics"},
    "ddpg": {**DDPG, "target_update_interval": 2, "action_l2": 1.0},
    "per": PER,
    "widths between bounds": {"log_std_form": "tanh", "log_std_bounds": (-5.0, 2.0)},
}


@pytest.mark.parametrize("settings", list(VARIANTS.values()), ids=list(VARIANTS))
def test_replayed_updates_are_the_updates(settings: dict[str, Any]) -> None:
    register_uneven()
    recorder = CpuRecorder()
    algo = captured(build(**settings), recorder)
    assert fingerprint(algo, 3) == fingerprint(build(**settings), 3)
    # Captured anew for each length of the longest episode.
    assert recorder.replays > (5 if "task" in settings else 20)


def test_after_a_restore_they_are_captured_anew(tmp_path: Any) -> None:
    algo = captured(build(**HER), CpuRecorder())
    fingerprint(algo, 2)
    algo.save_to_path(tmp_path / "checkpoint")
    expected = fingerprint(algo, 1)
    for again in (algo, build(**HER)):
        again.restore_from_path(tmp_path / "checkpoint")
        assert fingerprint(again, 1) == expected


def test_what_cannot_be_captured_runs_as_before_and_is_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Refusing(CpuRecorder):
        def record(self, function: Function) -> tuple[Mapping[Any, Tensor], Replay]:
            raise RuntimeError("operation not permitted when stream is capturing")

    expected = fingerprint(build(**HER), 3)
    with caplog.at_level(logging.WARNING, logger="music_rllib"):
        assert fingerprint(captured(build(**HER), Refusing()), 3) == expected
    assert caplog.text.count("operation not permitted") == 1


if torch.cuda.is_available():  # a machine without a GPU lacks nothing that can be installed

    @pytest.mark.parametrize("settings", list(VARIANTS.values()), ids=list(VARIANTS))
    def test_on_a_gpu_captured_updates_are_the_updates(settings: dict[str, Any]) -> None:
        register_uneven()

        def on_gpu() -> TAC:
            return build(**settings, where={"num_gpus_per_learner": 1})

        eager, graphed = on_gpu(), on_gpu()
        eager.learner_group._learner._captured = None
        assert isinstance(graphed.learner_group._learner._captured._recorder, CudaRecorder)
        expected, found = fingerprint(eager, 3), fingerprint(graphed, 3)
        assert not graphed.learner_group._learner._captured._gave_up
        for row, same in zip(found, expected, strict=True):
            assert row == pytest.approx(same, rel=1e-3, abs=1e-4)
