"""Training on a GPU: the numbers of a CPU, exact resumption, sweeps whose runs share a GPU.

`pytest -m gpu` runs them, and they fail on a machine without an NVIDIA GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from music_rllib import names
from tests.faults import comparison, sweeps
from tests.integration.algorithm.test_compiled_updates import VARIANTS
from tests.integration.algorithm.test_tac_algorithm import (
    HER,
    MUSIC_U,
    build,
    fingerprint,
    register_uneven,
)
from tests.processes import fresh

pytestmark = pytest.mark.gpu

ON_GPU = {"num_gpus_per_learner": 1}
SETTINGS: dict[str, dict[str, Any]] = {
    **VARIANTS,
    "joint": {"entropic_index": 1.5, "entropy_form": "joint", "music": MUSIC_U},
    "layer norm": {"entropic_index": 1.5, "layer_norm": "all", "replay.symmetries": ("mirror",)},
    "SMILE": {"music": {**MUSIC_U, "bound": "smile"}, "task": "Uneven"},
    "RND": {**HER, "intrinsic.reward": "rnd", "entropic_index": 1.5},
    "E3B": {"intrinsic.reward": "e3b"},
    "DIAYN": {"intrinsic.reward": "diayn"},
}


@pytest.fixture(autouse=True)
def gpu() -> None:
    assert torch.cuda.is_available(), "these tests need an NVIDIA GPU that PyTorch sees"


@pytest.fixture
def same_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A generator on a GPU produces the same numbers as one on a CPU with the same seed."""
    twins: dict[int, torch.Generator] = {}

    def on_cpu(draw: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def drawn(*size: Any, generator: Any = None, device: Any = None, **options: Any) -> Tensor:
            if generator is None or generator.device.type == "cpu":
                return draw(*size, generator=generator, device=device, **options)
            new = torch.Generator().manual_seed(generator.initial_seed())
            twin = twins.setdefault(id(generator), new)
            return draw(*size, generator=twin, **options).to(generator.device)

        return drawn

    for name in ("rand", "randn"):
        monkeypatch.setattr(torch, name, on_cpu(getattr(torch, name)))


@pytest.mark.usefixtures("local_ray", "same_random_numbers")
@pytest.mark.parametrize("settings", list(SETTINGS.values()), ids=list(SETTINGS))
def test_training_equals_a_cpus_up_to_rounding(settings: dict[str, Any]) -> None:
    register_uneven()
    rounds = 3 if "task" in settings else 2
    on_gpu = build(where=ON_GPU, **settings)
    assert {p.device.type for p in on_gpu.learner_group._learner._online} == {"cuda"}
    found, expected = fingerprint(on_gpu, rounds), fingerprint(build(**settings), rounds)
    for row, same in zip(found, expected, strict=True):
        # Objects at rest have the lowest reward up to rounding of the bound.
        counted = row.pop(names.MI_REWARD_LOWEST, 0.0)
        assert counted == pytest.approx(same.pop(names.MI_REWARD_LOWEST, 0.0), abs=0.06)
        assert row == pytest.approx(same, rel=1e-3, abs=1e-4)


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("name", ["music-u", "SMILE", "tqc", "redq", "per", "RND", "E3B"])
def test_a_checkpoint_made_on_a_gpu_continues_there_exactly(name: str, tmp_path: Path) -> None:
    register_uneven()
    unbroken = build(where=ON_GPU, **SETTINGS[name])
    fingerprint(unbroken, 2)
    unbroken.save_to_path(tmp_path / "checkpoint")
    saved = unbroken.get_network_weights()
    expected = fingerprint(unbroken, 3)
    resumed = build(where=ON_GPU, **SETTINGS[name])
    resumed.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(resumed, 3) == expected
    # Without a GPU, it continues from the same weights with other random numbers.
    on_cpu = build(**SETTINGS[name])
    on_cpu.restore_from_path(tmp_path / "checkpoint")
    np.testing.assert_equal(on_cpu.get_network_weights(), saved)
    assert on_cpu.grad_updates < (fingerprint(on_cpu, 2), on_cpu.grad_updates)[1]


@pytest.mark.timeout(900)
def test_a_sweep_with_two_runs_on_a_gpu_is_killed_resumed_and_read_without_one(
    tmp_path: Path,
) -> None:
    document = sweeps.document(resources={"num_cpus": 2, "gpus_per_run": 0.5})
    document["defaults"]["env_steps"] = 2000
    unbroken, cut = (sweeps.program(tmp_path / name) for name in ("unbroken", "cut"))
    for program in (unbroken, cut):
        program.folder.mkdir()
        program.write(document)
    sweeps.finish(unbroken)
    for sign in ("pretrain/seed0: 8", "finetune/q=2/seed0: 8"):
        sweeps.kill(sweeps.start_until(cut, sign))
    sweeps.finish(cut)
    comparison.same(unbroken.folder / "results", cut.folder / "results")
    # Another run starts from the handoff, and plays the policy, on a machine without a GPU.
    cut.environment = cut.environment | {"CUDA_VISIBLE_DEVICES": ""}
    document["stages"][1]["grid"] = {"tac.entropic_index": [1.0, 1.5, 2.0]}
    cut.write(document | {"resources": {"num_cpus": 2}})
    output = sweeps.finish(cut)
    assert output.count("finished earlier, reused") == 3
    for program in (unbroken, cut):
        program.end_all()
    play = ("-m", "music_rllib", "evaluate", "finetune/q=2/seed0", "--json")
    fresh(*play, cwd=cut.folder, env=cut.environment)
