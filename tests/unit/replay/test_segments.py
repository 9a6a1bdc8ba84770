"""The replay's files: the bytes that a checkpoint writes, without any loss."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from music_rllib.replay import ring as module
from music_rllib.replay.buffer import TrajectoryReplay
from music_rllib.replay.ring import TRAJECTORIES_PER_SEGMENT, Segment, new_segments
from music_rllib.replay.trajectories import ReplayLayout, Trajectory
from music_rllib.store.serialization import read_arrays, read_state, write_arrays, write_state

pytestmark = pytest.mark.faults


LAYOUT = ReplayLayout(observation=2, action=1, goal=1, horizon=5)


def make(capacity: int = 20, *, seed: int = 0, td: bool = False) -> TrajectoryReplay:
    return TrajectoryReplay(
        LAYOUT,
        capacity,
        np.random.default_rng(seed),
        goal_reward=lambda achieved, desired: -np.abs(achieved - desired)[:, 0],
        hindsight_k=4.0,
        td_exponent=0.6 if td else None,
    )


def episode(rng: np.random.Generator, steps: int) -> Trajectory:
    return Trajectory(
        rng.normal(size=(steps + 1, LAYOUT.frame)).astype(np.float32),
        rng.normal(size=(steps, LAYOUT.action)).astype(np.float32),
        rng.normal(size=steps).astype(np.float32),
        terminated=bool(rng.random() < 0.5),
    )


class Disk:
    """A folder of segments, which counts the bytes written to it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written = 0

    def write(self, label: str, arrays: Mapping[str, NDArray[Any]]) -> str:
        path = self.folder / f"{label}-{len(list(self.folder.iterdir()))}"
        write_arrays(path, arrays)
        self.written += path.stat().st_size
        return path.name

    def parts(self, segments: list[Segment]) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        return ((each.first, read_arrays(self.folder / each.name)) for each in segments)


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    (tmp_path / "segments").mkdir()
    return Disk(tmp_path / "segments")


batches = st.lists(st.lists(st.integers(1, 5), max_size=7), min_size=1, max_size=8)


@given(
    lengths=batches,
    td=st.booleans(),
    ranked=st.booleans(),
    seed=st.integers(0, 99),
    most=st.integers(1, 5),
)
@settings(max_examples=60, deadline=None)
def test_saving_a_loaded_replay_gives_the_same_bytes(
    lengths: list[list[int]], td: bool, ranked: bool, seed: int, most: int, tmp_path_factory: Any
) -> None:
    """For random contents and wrap-arounds, with checkpoints at random times."""
    folder = tmp_path_factory.mktemp("replay")
    disk = Disk(folder)
    rng = np.random.default_rng(seed)
    original = make(12, seed=seed, td=td)
    segments: list[Segment] = []
    for batch in lengths:
        episodes = [episode(rng, steps) for steps in batch]
        original.extend(episodes, rng.random(len(batch)) if ranked else None)
        if len(original):
            drawn = original.sample_transitions(3)
            if td:
                assert drawn.rows is not None
                original.update_priorities(drawn.rows, rng.random(3).astype(np.float32))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "TRAJECTORIES_PER_SEGMENT", most)
            segments = new_segments(original, segments, disk.write)
    loaded = make(12, seed=seed + 1, td=td)
    loaded.load_packed(original.index(), disk.parts(segments))

    first, second = (folder / name for name in ("first", "second"))
    for replay, place in ((original, first), (loaded, second)):
        place.mkdir()
        write_state(place, {"index": replay.index(), "packed": replay.packed(replay.oldest)})
    assert (first / "state.json").read_bytes() == (second / "state.json").read_bytes()
    assert (first / "state.safetensors").read_bytes() == (second / "state.safetensors").read_bytes()

    more = [episode(rng, steps) for steps in (5, 1, 4)]
    for replay in (original, loaded):
        replay.extend(more, np.arange(3.0) if ranked else None)
    ours, theirs = original.sample_transitions(64), loaded.sample_transitions(64)
    for field in ("inputs", "actions", "rewards", "discounts", "next_inputs"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))


def test_a_checkpoint_writes_only_new_data(disk: Disk) -> None:
    layout = ReplayLayout(observation=25, action=4, goal=3, horizon=50)
    replay = TrajectoryReplay(layout, 225_000, np.random.default_rng(0))
    whole = Trajectory(
        np.ones((51, layout.frame), np.float32),
        np.ones((50, 4), np.float32),
        np.ones(50, np.float32),
        terminated=False,
    )
    replay.extend([whole] * 4_500)
    assert len(replay) == 225_000
    segments = new_segments(replay, [], disk.write)
    assert disk.written == pytest.approx(33.3e6, rel=0.03)
    disk.written = 0
    replay.extend([whole] * 40)
    segments = new_segments(replay, segments, disk.write)
    assert disk.written == pytest.approx(33.3e6 * 40 / 4_500, rel=0.03)
    ends = [*range(0, 4_500, TRAJECTORIES_PER_SEGMENT), 4_500, 4_540]
    assert [(segment.first, segment.end) for segment in segments] == list(pairwise(ends))
    disk.written = 0
    assert new_segments(replay, segments, disk.write) == segments
    assert disk.written == 0


def test_segments_of_overwritten_trajectories_are_dropped(disk: Disk) -> None:
    rng, replay, segments = np.random.default_rng(0), make(20), list[Segment]()
    for _ in range(5):
        replay.extend([episode(rng, 5), episode(rng, 5)])
        segments = new_segments(replay, segments, disk.write)
    assert [(segment.first, segment.end) for segment in segments] == [(6, 8), (8, 10)]


def test_missing_or_too_many_trajectories_are_refused(disk: Disk) -> None:
    rng, replay = np.random.default_rng(0), make(20)
    replay.extend([episode(rng, 5)])
    first = new_segments(replay, [], disk.write)
    replay.extend([episode(rng, 5)])
    both = new_segments(replay, first, disk.write)
    with pytest.raises(ValueError, match="trajectory 1 must be in the checkpoint's files"):
        make(20).load_packed(replay.index(), disk.parts(both[:1]))
    with pytest.raises(ValueError, match="trajectory 0 must be in the checkpoint's files"):
        make(20).load_packed(replay.index(), disk.parts(both[1:]))
    with pytest.raises(ValueError, match="the replay holds 6 frames, the checkpoint has 12"):
        make(5).load_packed(replay.index(), disk.parts(both))


def test_plain_states_keep_values_and_types(tmp_path: Path) -> None:
    state = {
        "a": [1, -2.5, None, True, "text", (1, (2,))],
        7: {"big": 2**127 + 1, "nan": float("nan"), "array": np.arange(6.0).reshape(2, 3).T},
        "scalar": np.float64(0.1),
        "empty": np.zeros((0, 3), np.int32),
        "flag": np.array(True),
    }
    write_state(tmp_path, state)
    found = read_state(tmp_path)
    np.testing.assert_equal(found, state)
    assert [type(key) for key in found] == [str, int, str, str, str]
    assert type(found["a"][5]) is tuple
    assert type(found["scalar"]) is np.float64
    assert found["flag"].dtype == np.bool_
    again = tmp_path / "again"
    again.mkdir()
    write_state(again, found)
    for file in ("state.json", "state.safetensors"):
        assert (again / file).read_bytes() == (tmp_path / file).read_bytes()


@pytest.mark.parametrize("value", [object(), {(1, 2): 3}, np.array(["text"]), {"x": [print]}])
def test_an_object_in_the_state_is_refused(value: Any, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"^state\S* must "):
        write_state(tmp_path, value)
