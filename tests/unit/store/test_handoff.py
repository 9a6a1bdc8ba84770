"""Handoffs return the same weights, and a changed handoff is refused."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.store.handoff import (
    Architecture,
    HandoffError,
    NetworkWeights,
    open_handoff,
    read_handoff,
    write_handoff,
)
from tests.handoffs import music_u
from tests.hostile_files import SPACES, Bomb

PUSH, SLIDE = BUILT_IN_TASKS["FetchPush"], BUILT_IN_TASKS["FetchSlide"]
INFO = music_u().handoff_info("0" * 20, 6000, SPACES)
WEIGHTS: NetworkWeights = {
    "mi_estimator": {"x.weight": np.arange(6, dtype=np.float32).reshape(2, 3)},
    "normaliser": {"count": np.array(7, np.int64), "mean": np.linspace(0, 1, 5)},
}


@pytest.fixture
def handoff(tmp_path: Path) -> Path:
    write_handoff(tmp_path / "handoff", WEIGHTS, INFO)
    return tmp_path / "handoff"


@given(
    array=arrays_of.arrays(
        dtype=st.sampled_from([np.float32, np.float64, np.int64, np.uint8]),
        shape=arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
        elements={"allow_nan": False, "allow_infinity": False},
    ),
    order=st.sampled_from(["C", "F", "reversed"]),
)
def test_any_array_round_trips(
    tmp_path_factory: pytest.TempPathFactory, array: np.ndarray[Any, Any], order: str
) -> None:
    folder = tmp_path_factory.mktemp("handoff")
    laid = array[..., ::-1] if order == "reversed" and array.ndim else np.asarray(array, order="F")
    write_handoff(folder, {"policy": {"a": laid}}, INFO)
    found = read_handoff(folder, ["policy"], PUSH)["policy"]["a"]
    assert (found.shape, found.dtype) == (laid.shape, laid.dtype)
    np.testing.assert_array_equal(found, laid)


def test_only_the_name_of_a_task_may_differ(handoff: Path) -> None:
    read_handoff(handoff, ["normaliser"], PUSH.model_copy(update={"name": "Mine"}))
    with pytest.raises(HandoffError, match="must be of task FetchSlide, it is of FetchPush"):
        read_handoff(handoff, ["normaliser"], SLIDE)
    other_split = PUSH.model_copy(update={"surrounding_indices": (3, 4)})
    with pytest.raises(HandoffError, match=r"indices is \[3, 4, 5\] there and \[3, 4\] here"):
        read_handoff(handoff, ["normaliser"], other_split)


def test_a_handoff_is_found_in_a_node_folder(handoff: Path) -> None:
    folder, manifest = open_handoff(handoff.parent)
    assert folder == handoff
    assert manifest.info == INFO


def refusal(folder: Path, modules: tuple[str, ...] = ("mi_estimator",)) -> str:
    with pytest.raises(HandoffError) as error:
        read_handoff(folder, modules, PUSH)
    return str(error.value)


def test_missing_parts_are_named(handoff: Path) -> None:
    assert "the folder does not exist" in refusal(handoff / "nowhere")
    assert "it lacks policy (trained with music-u)" in refusal(handoff, ("policy", "normaliser"))
    (handoff / "mi_estimator.safetensors").unlink()
    assert "mi_estimator.safetensors must be readable" in refusal(handoff)
    (handoff / "handoff.json").unlink()
    assert "the folder exists" in refusal(handoff)


def test_damage_is_named(handoff: Path) -> None:
    weights = handoff / "mi_estimator.safetensors"
    sound = weights.read_bytes()
    weights.write_bytes(sound[:-1])
    assert f"must have {len(sound)} bytes, it has {len(sound) - 1}" in refusal(handoff)
    weights.write_bytes(sound[:-1] + bytes([sound[-1] ^ 1]))
    assert "its content has changed" in refusal(handoff)
    (handoff / "handoff.json").write_text("{")
    assert "must be a handoff manifest" in refusal(handoff)


def forge(handoff: Path, data: bytes, **changes: Any) -> None:
    """Replace the weights by `data`, and change the manifest to match."""
    import hashlib

    manifest = json.loads((handoff / "handoff.json").read_text())
    entry = manifest["modules"]["mi_estimator"]
    entry |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} | changes
    (handoff / "handoff.json").write_text(json.dumps(manifest))
    (handoff / "mi_estimator.safetensors").write_bytes(data)


def test_a_pickle_in_place_of_weights_never_runs(handoff: Path, tmp_path: Path) -> None:
    bomb = pickle.dumps(Bomb(tmp_path / "exploded"))
    weights = handoff / "mi_estimator.safetensors"
    weights.write_bytes(bomb)
    assert "bytes, more than" in refusal(handoff)
    forge(handoff, bomb)
    assert "must be a safetensors file" in refusal(handoff)
    assert not (tmp_path / "exploded").exists()
    pickle.loads(bomb)
    assert (tmp_path / "exploded").exists(), "the bomb works"


def test_a_forged_manifest_cannot_point_elsewhere(handoff: Path) -> None:
    data = (handoff / "mi_estimator.safetensors").read_bytes()
    forge(handoff, data, file="../mi_estimator.safetensors")
    assert "must be a handoff manifest" in refusal(handoff)


def test_arrays_must_be_those_of_the_manifest(handoff: Path) -> None:
    data = (handoff / "mi_estimator.safetensors").read_bytes()
    forge(handoff, data, arrays={"x.weight": {"shape": [3, 2], "dtype": "float32"}})
    assert "must have the arrays in handoff.json; wrong: x.weight" in refusal(handoff)


def test_weights_of_a_diverged_run_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"policy\.w must be finite"):
        write_handoff(tmp_path, {"policy": {"w": np.array([1.0, np.nan])}}, INFO)
    with pytest.raises(HandoffError):
        open_handoff(tmp_path)


def test_a_buffer_of_a_reward_may_hold_infinity(tmp_path: Path) -> None:
    lowest = np.array([np.inf, 0.5], np.float32)
    write_handoff(tmp_path, {"intrinsic": {"lowest": lowest}}, INFO)
    found = read_handoff(tmp_path, ["intrinsic"], PUSH)["intrinsic"]["lowest"]
    np.testing.assert_array_equal(found, lowest)


def test_the_content_hash_depends_on_weights_and_task_only(tmp_path: Path) -> None:
    def content_hash(name: str, weights: NetworkWeights, **changes: Any) -> str:
        info = INFO.model_copy(update=changes)
        return write_handoff(tmp_path / name, weights, info).content_hash

    one = content_hash("a", WEIGHTS)
    assert content_hash("b", WEIGHTS, node_key="1" * 20, env_steps=9) == one
    assert content_hash("c", WEIGHTS, task=SLIDE) != one
    shifted = {**WEIGHTS, "normaliser": {"mean": np.zeros(5)}}
    assert content_hash("d", shifted) != one


@pytest.mark.parametrize(("policy", "critics"), [("stochastic", 2), ("deterministic", 1)])
def test_the_default_number_of_critics_is_that_of_the_policy(policy: str, critics: int) -> None:
    def made(number: int | None) -> Architecture:
        return Architecture(
            hidden_sizes=(8,),
            policy=policy,
            bootstrap="critics",
            normalise_observations=True,
            estimator_hidden_size=8,
            log_std_form="clamp",
            log_std_bounds=None,
            critics=number,
        )

    assert made(None).differences(made(critics), "policy") == []
    assert made(None).differences(made(3), "policy") == ["tac.critics"]
