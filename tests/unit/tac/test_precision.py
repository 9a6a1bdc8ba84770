"""bfloat16 products: close to float32, in float32 outside, and refused where there are none."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from music_rllib.config.load import load_sweep
from music_rllib.errors import BadInputError
from music_rllib.experiment.plan import make_plan
from music_rllib.sweep.preflight import check_hardware
from music_rllib.tac.kernels import precision
from music_rllib.tac.kernels.precision import PrecisionError, check_precision
from music_rllib.tac.networks import Critics, Perceptron


def pair(kind: str) -> tuple[torch.nn.Module, torch.nn.Module]:
    """The same network in float32 and with bfloat16 products."""

    def network(bf16: bool) -> torch.nn.Module:
        torch.manual_seed(0)
        if kind == "critics":
            return Critics(12, (64, 64), bf16=bf16)
        return Perceptron(12, (64, 64), 3, bf16=bf16)

    return network(False), network(True)


def gradients(network: torch.nn.Module, inputs: Tensor) -> Tensor:
    network(inputs).square().sum().backward()
    return torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])


@pytest.mark.parametrize("kind", ["perceptron", "critics"])
def test_bf16_is_close_to_float32_and_its_weights_and_outputs_are_float32(kind: str) -> None:
    exact, rounded = pair(kind)
    inputs = torch.randn(32, 12, generator=torch.Generator().manual_seed(1))
    wanted, found = exact(inputs), rounded(inputs)
    assert found.dtype == torch.float32
    assert not torch.equal(wanted, found), "bf16 was not used"
    assert torch.allclose(wanted, found, atol=0.02)
    wanted, found = gradients(exact, inputs), gradients(rounded, inputs)
    assert found.dtype == torch.float32
    assert torch.nn.functional.cosine_similarity(wanted, found, dim=0) > 0.99
    # Checkpoints and handoffs do not depend on the precision.
    assert exact.state_dict().keys() == rounded.state_dict().keys()
    assert {value.dtype for value in rounded.state_dict().values()} == {torch.float32}


def test_bf16_is_refused_without_hardware_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "cpu_flags", lambda: frozenset({"avx2", "avx512f"}))
    with pytest.raises(PrecisionError, match=r"tac\.precision must be float32 here, got 'bf16'"):
        check_precision("bf16")
    check_precision("float32")
    monkeypatch.setattr(precision, "cpu_flags", lambda: frozenset({"avx512_bf16"}))
    check_precision("bf16")


def test_a_local_sweep_in_bf16_is_refused_before_it_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(precision, "cpu_flags", lambda: frozenset({"avx2"}))
    file = tmp_path / "sweep.yaml"
    file.write_text(
        "name: fast\ntasks: [FetchReach]\ndefaults: {tac: {precision: bf16}}\n"
        "stages: [{name: train, variant: tac}]\n"
    )
    with pytest.raises(BadInputError, match="this CPU has none of amx_bf16, avx512_bf16, bf16"):
        check_hardware(make_plan(load_sweep(file)))
