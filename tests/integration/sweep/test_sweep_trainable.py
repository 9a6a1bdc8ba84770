"""One run as a Tune trial: every variant, from its source, and resumed after an interruption."""

from __future__ import annotations

import math
import re
import shutil
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.utils.metrics import LEARNER_RESULTS
from ray.tune.trainable import trainable

from music_rllib import names
from music_rllib.config.run_settings import RunSettings, Variant, handed_over, variant_music
from music_rllib.config.schema import Resources
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.experiment.plan import node_key
from music_rllib.intrinsic.music import HELD_OUT_STEPS
from music_rllib.policy import find_policy, load_policy
from music_rllib.store.handoff import read_handoff
from music_rllib.store.history import from_json_lines
from music_rllib.store.node_store import NodeStore
from music_rllib.training import run as run_module
from music_rllib.training import run_storage, sample_run
from music_rllib.training.job import NodeJob
from music_rllib.training.run import TrainingRun, _means, _training_metrics
from music_rllib.training.worker import CAUSE, LEFT, NOTES, REPORTS, RunTrainable

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[3]
ENVIRONMENTS = ROOT / "tests" / "environments"
POINT = Task(
    name="Point",
    env_id="point_env:Point-v0",
    horizon=20,
    agent_indices=(0, 1),
    surrounding_indices=(2, 3),
)


@pytest.fixture(scope="module", autouse=True)
def point_environment() -> Iterator[None]:
    """The environment can be imported, and torch has one thread."""
    sys.path.insert(0, str(ENVIRONMENTS))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    sys.path.remove(str(ENVIRONMENTS))


@pytest.fixture(autouse=True)
def nothing_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Outside Tune, a trainable's folder would be created in the user's home."""
    monkeypatch.setattr(trainable, "DEFAULT_STORAGE_PATH", str(tmp_path))


def settings(variant: Variant, **changes: Any) -> RunSettings:
    base = {
        "task": POINT,
        "variant": variant,
        "seed": 3,
        "env_steps": 600,
        "num_envs": 2,
        "evaluation": {"interval": 200, "episodes": 2},
        "tac": {"random_steps": 100, "hidden_sizes": [16], "batch_size": 16, "replay_ratio": 0.2},
        "music": variant_music(variant, POINT) | {"hidden_size": 16, "batch_trajectories": 4},
    }
    return RunSettings.model_validate(base | changes)


def job(storage: Path, run: RunSettings, source: NodeJob | None = None) -> NodeJob:
    source_key = source.key if source else None
    return NodeJob(
        key=node_key(run, source_key),
        label=run.variant,
        run=run,
        source_key=source_key,
        source_task=POINT if source else None,
        storage=str(storage),
    )


def compute(node: NodeJob, steps: int | None = None) -> list[dict[str, Any]]:
    """Results of a trial, of its first `steps` steps or to its end."""
    trial = RunTrainable(config=node.to_tune())
    results: list[dict[str, Any]] = []
    try:
        while not (results and results[-1]["done"]) and len(results) != steps:
            results.append(trial.train())
    finally:
        trial.stop()
    return results


def numbers(storage: Path, node: NodeJob) -> list[dict[str, float]]:
    """A finished run's metrics by report, without the metrics of the machine."""
    return [
        {name: value for name, value in report.metrics.items() if not name.startswith("system/")}
        for report in NodeStore(str(storage)).history(node.key)
    ]


@pytest.fixture(scope="module")
def pretrained(local_ray: None, tmp_path_factory: pytest.TempPathFactory) -> NodeJob:
    """A finished run of MUSIC-u, from which others start."""
    source = job(tmp_path_factory.mktemp("storage"), settings("music-u"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainable, "DEFAULT_STORAGE_PATH", source.storage)
        compute(source)
    return source


@pytest.mark.usefixtures("local_ray")
def test_diverged_critics_are_reported_once(tmp_path: Path) -> None:
    """The task declares far smaller rewards than its environment returns."""
    task = POINT.model_copy(update={"reward_range": (-1e-6, 0.0)})
    tac = settings("tac").tac.model_dump() | {"alpha": 0.0}
    results = compute(job(tmp_path, settings("tac", task=task, tac=tac)))
    (note,) = [note for result in results for note in result[NOTES] if "critics" in note]
    assert re.match(r"its critics diverge: \S+ on average, with rewards of -1e-06 to 0 ", note)
    assert note.endswith("; tac.target_bounds limits their targets")


def test_every_variant_trains_from_its_source(pretrained: NodeJob) -> None:
    source, storage = pretrained, Path(pretrained.storage)
    store = NodeStore(source.storage)
    variants: list[Variant] = ["tac", "music-r", "music-f", "music-p"]
    for variant in variants:
        node = job(storage, settings(variant), source if variant != "tac" else None)
        assert compute(node)[-1]["done"]
        result = store.result(node.key)
        assert result is not None
        assert result.env_steps == 600
        assert names.EVAL_SUCCESS in result.metrics
        store.verify(node.key)
        if variant in {"music-r", "music-p"}:
            before, after = (estimator(store, key) for key in (source.key, node.key))
            assert before.keys() == after.keys()
            for name, array in before.items():
                np.testing.assert_array_equal(after[name], array, "it must be frozen")


def estimator(store: NodeStore, key: str) -> dict[str, Any]:
    return read_handoff(Path(store.path(key)), ["mi_estimator"], POINT)["mi_estimator"]


def test_music_f_starts_with_the_agent_of_its_source(pretrained: NodeJob, tmp_path: Path) -> None:
    shutil.copytree(pretrained.storage, tmp_path, dirs_exist_ok=True)
    source = pretrained
    node = job(tmp_path, settings("music-f"), source)
    trial = RunTrainable(config=node.to_tune())
    begun = trial._begin()
    folder = Path(NodeStore(str(tmp_path)).path(source.key))
    expected = read_handoff(folder, handed_over(node.run), POINT)
    assert set(expected) == {"policy", "critics", "value", "value_target", "normaliser"}
    found = begun.network_weights()
    # MUSIC-u's goals were zeros, so their moments start again (observation 4, goal 2).
    for name in ("count", "centre", "squares"):
        expected["normaliser"][name][4:] = 0.0
    for module, arrays in expected.items():
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[module][name], array)
    begun.advance()
    begun.advance()
    inputs = begun.algorithm.replay.packed(0)["frames"][:, :6]
    counts = begun.network_weights()["normaliser"]["count"]
    np.testing.assert_array_equal(counts - np.array([630.0] * 4 + [0.0] * 2), len(inputs))
    normalised = begun.algorithm.env_runner.module.normaliser(torch.from_numpy(inputs)).numpy()
    np.testing.assert_allclose(normalised[:, 4:].std(axis=0), 1.0, rtol=1e-5)
    begun.close()


@pytest.mark.usefixtures("local_ray")
def test_evaluating_the_untrained_policy_does_not_change_training() -> None:
    def trained(*, evaluated: bool) -> tuple[list[dict[str, float]], Any]:
        run = TrainingRun(settings("music-r"))
        run._begun = not evaluated
        reports = []
        while not run.finished:
            reports.append(run.advance())
        run.close()
        return reports, run.network_weights()["policy"]

    reports, policy = trained(evaluated=True)
    first, *rest = reports
    assert first[names.ENV_STEPS] == first[names.GRAD_UPDATES] == 0
    assert first[names.EVAL_EPISODES] == settings("music-r").evaluation.episodes
    assert names.TRAIN_RETURN not in first
    others, same_policy = trained(evaluated=False)
    learned = {key for key in rest[-1] if key.startswith(names.LEARNER_GROUPS)}
    assert learned
    for report, other in zip(rest, others, strict=True):
        assert {key: report.get(key) for key in learned} == {key: other.get(key) for key in learned}
    for name, array in policy.items():
        np.testing.assert_array_equal(array, same_policy[name])


@pytest.mark.usefixtures("local_ray")
def test_a_task_sets_the_distance_that_counts_as_moved() -> None:
    def weights(far: float | None, episodes: str) -> Any:
        task = POINT.model_copy(update={"moved_distance": far})
        replay = {"hindsight_k": 4.0, "hindsight_episodes": episodes}
        run = TrainingRun(settings("tac", task=task, replay=replay))
        while not run.finished:
            run.advance()
        run.close()
        return run.network_weights()["policy"]["0.weight"]

    # 100 is more than any movement; without a distance, the reward decides.
    without = weights(None, "all")
    np.testing.assert_array_equal(weights(100.0, "moved"), without)
    assert (weights(None, "moved") != without).any()


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("variant", ["music-u", "tac"])
def test_a_resumed_run_ends_with_the_numbers_of_an_uninterrupted_one(
    tmp_path: Path, variant: Variant
) -> None:
    """Also if q depends on the entropy, and the weight of MUSIC's reward on the success rate."""
    run = settings(variant, env_steps=800)
    q = {"follows": "shannon_entropy", "points": [[0.0, 1.0], [1.5, 2.0]], "smoothing": 100.0}
    follows = {"tac": {**run.tac.model_dump(), "entropic_index": q}}
    if variant == "music-u":
        weight = {"follows": "success_rate", "points": [[0.0, 1.0], [1.0, 0.0]]}
        follows["music"] = {**run.music.model_dump(), "mi_reward_weight": weight}
    run = RunSettings.model_validate({**run.model_dump(), **follows})
    unbroken = job(tmp_path / "a", run)
    compute(unbroken)
    cut = job(tmp_path / "b", run)
    assert cut.key == unbroken.key
    assert [result["done"] for result in compute(cut, steps=3)] == [False, False, False]
    # Steps after the last checkpoint are lost, as after a kill.
    results = compute(cut)
    assert results[0][NOTES] == ["continues at 400 env steps"]
    told = [report.env_steps for r in results for report in from_json_lines(r[REPORTS].encode())]
    assert told == [0, 200, 400, 600, 800], "the driver may not have received the first ones"
    assert numbers(tmp_path / "b", cut) == numbers(tmp_path / "a", unbroken)
    assert NodeStore(str(tmp_path / "b")).work_folder(cut.key).names() == []
    rows = [row for row in numbers(tmp_path / "a", unbroken) if names.ENTROPIC_INDEX_FOLLOWS in row]
    assert len({row[names.ENTROPIC_INDEX] for row in rows}) == len(rows) >= 3
    for before, row in pairwise(numbers(tmp_path / "a", unbroken)):
        if variant == "music-u" and names.MI_REWARD_WEIGHT_FOLLOWS in row:
            assert row[names.MI_REWARD_WEIGHT_FOLLOWS] == before[names.EVAL_SUCCESS]
            assert row[names.MI_REWARD_WEIGHT] == 1.0 - before[names.EVAL_SUCCESS]


def test_a_report_weights_the_bound_on_new_episodes_by_their_steps() -> None:
    rounds = {"a": [1.0, 3.0], names.HELD_OUT_BOUND: [0.1, 0.4], HELD_OUT_STEPS: [30.0, 10.0]}
    assert _means(rounds) == pytest.approx({"a": 2.0, names.HELD_OUT_BOUND: 0.175})
    assert _means({"a": [1.0]}) == {"a": 1.0}


def test_an_iteration_without_an_update_has_no_metrics_of_updates() -> None:
    learned = {"loss/critic": math.nan, "critics/mean": np.float32(2.0), "fps": 3.0}
    assert dict(_training_metrics({LEARNER_RESULTS: {DEFAULT_MODULE_ID: learned}})) == {
        "critics/mean": 2.0
    }


@pytest.mark.usefixtures("local_ray")
def test_iterations_without_updates_leave_no_gap_in_the_curves(tmp_path: Path) -> None:
    """An iteration plays 20 steps, and there is an update every 40 steps."""
    base = settings("tac").tac.model_dump()
    run = settings("tac", num_envs=1, tac=base | {"replay_ratio": 0.025})
    node = job(tmp_path, run)
    compute(node)
    rows = [row for row in numbers(tmp_path, node) if row.get(names.GRAD_UPDATES)]
    assert rows
    assert not [row for row in rows for value in row.values() if math.isnan(value)]


@pytest.mark.usefixtures("local_ray")
def test_a_nan_from_the_environment_is_named_and_the_last_checkpoint_stays(tmp_path: Path) -> None:
    task = POINT.model_copy(update={"env_kwargs": {"nan_at": 150}})
    node = job(tmp_path, settings("tac", task=task))
    *_, last = compute(node)
    assert last["done"]
    first, second = last[CAUSE].splitlines()
    # Evaluations have environments of their own.
    assert re.fullmatch(
        r"BadNumberError: Point-v0, sub-environment 0, training episode 15 \(reset with seed \d+\),"
        r" step 10: observation\[2\] is nan, every number must be finite and within \+-1e\+15",
        first,
    )
    assert second.endswith("its last checkpoint is good.")
    with NodeStore(str(tmp_path)).work_folder(node.key).newest(print) as saved:
        assert saved is not None
        again = TrainingRun(node.run)
        again.restore(saved)
        assert again.env_steps == 200
        assert all(
            np.isfinite(a).all() for m in again.network_weights().values() for a in m.values()
        )
        again.close()


@pytest.mark.usefixtures("local_ray")
def test_compiling_updates_is_announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "is_kept", lambda _: False)
    ((note,),) = [result[NOTES] for result in compute(job(tmp_path, settings("tac")), steps=1)]
    assert note.startswith("compiles its updates first")


def test_a_finished_node_is_not_trained_again(pretrained: NodeJob) -> None:
    node = pretrained
    manifest = Path(NodeStore(node.storage).path(node.key)) / "manifest.json"
    before = manifest.stat().st_mtime_ns
    (result,) = compute(node)
    assert (result["done"], LEFT in result) == (True, True)
    assert manifest.stat().st_mtime_ns == before


@pytest.mark.usefixtures("local_ray")
def test_a_damaged_checkpoint_is_skipped_and_a_new_version_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = job(tmp_path, settings("tac"))
    versions = {"version.torch": "2", "version.music-rllib": "0.1.0"}
    monkeypatch.setattr(run_storage, "provenance_tags", lambda: versions)
    compute(node, steps=3)
    versions = versions | {"version.music-rllib": "0.2.0"}
    newest = NodeStore(str(tmp_path)).work_folder(node.key).names()[-1]
    (tmp_path / "work" / node.key / newest / "history.jsonl").write_bytes(b"")
    notes = compute(node)[0][NOTES]
    assert len(notes) == 2
    assert newest in notes[0]
    change = "music-rllib 0.1.0 -> 0.2.0"
    assert notes[1] == f"continues at 200 env steps, under other versions than before: {change}"
    record = (tmp_path / "nodes" / node.key / "manifest.json").read_text()
    assert f'"{names.TAG_VERSIONS_CHANGED}": "at 200 env steps: {change}"' in record


@pytest.mark.usefixtures("local_ray")
def test_a_checkpoint_contains_its_current_policy(tmp_path: Path) -> None:
    node = job(tmp_path, settings("tac"))
    trial = RunTrainable(config=node.to_tune())
    for _ in range(2):
        trial.train()
    assert trial._training is not None
    module = trial._training.algorithm.env_runner.module
    inputs = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    expected = module.act(torch.from_numpy(inputs)).numpy()
    trial.stop()
    policy = load_policy(find_policy(node.key, str(tmp_path)))
    assert (policy.env_steps, policy.max_episode_steps) == (200, 20)
    np.testing.assert_allclose(policy.act(inputs), expected, atol=1e-6)


@pytest.mark.usefixtures("local_ray")
def test_runs_side_by_side_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_run, "SECONDS", 0.5)
    run = settings("tac", task=BUILT_IN_TASKS["FetchReach"])
    began = time.perf_counter()
    sample = sample_run.sample_run(run, Resources(cpus_per_run=1), at_once=2)
    took = time.perf_counter() - began
    assert 0 < sample.start_seconds < took
    assert 0 < sample.evaluation_seconds < took
    assert sample.steps_per_second > 20
    assert 5 * 2**20 < sample.memory < 2 * 2**30


def test_a_run_in_a_reused_process_has_the_same_numbers(
    pretrained: NodeJob, tmp_path: Path
) -> None:
    """The process has trained another run and failed once."""
    small = settings("music-u", seed=4, tac={"hidden_sizes": [8], "random_steps": 100})
    bad = settings("tac", task=POINT.model_copy(update={"env_id": "point_env:No-v0"}))
    last = job(tmp_path, settings("music-u"))
    trial = RunTrainable(config=job(tmp_path, small).to_tune())
    for node in (job(tmp_path, small), job(tmp_path, bad), last):
        assert trial.reset(node.to_tune())
        while not (result := trial.train())["done"]:
            pass
    trial.stop()
    assert CAUSE not in result
    assert numbers(tmp_path, last) == numbers(Path(pretrained.storage), pretrained)
