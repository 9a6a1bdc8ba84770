"""A run with more `env_steps` resumes from the end of the finished shorter one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from music_rllib.config.run_settings import RunSettings, Variant
from music_rllib.config.schema import Checkpoints
from music_rllib.envs.fingerprint import digest_of, fingerprint_of
from music_rllib.experiment.plan import budget_settings, continuation_key, is_continuable
from music_rllib.store.history import from_json_lines
from music_rllib.store.node_store import NodeStore
from music_rllib.training.worker import CAUSE, NOTES, REPORTS
from tests.integration.sweep.test_sweep_trainable import (
    compute,
    job,
    nothing_in_the_home_folder,
    numbers,
    point_environment,
    settings,
)

__all__ = ["nothing_in_the_home_folder", "point_environment"]  # automatic fixtures

pytestmark = pytest.mark.integration


@pytest.mark.usefixtures("local_ray")
@pytest.mark.parametrize("variant", ["music-u", "tac"])
def test_a_longer_run_resumes_and_ends_with_the_numbers_of_an_uninterrupted_one(
    tmp_path: Path, variant: Variant
) -> None:
    unbroken = job(tmp_path / "a", settings(variant, env_steps=1000))
    compute(unbroken)
    store = NodeStore(str(tmp_path / "b"))
    for budget in (400, 600):
        compute(job(tmp_path / "b", settings(variant, env_steps=budget)))
    longer = job(tmp_path / "b", settings(variant, env_steps=1000))
    results = compute(longer)
    note = "continues a finished run with fewer env_steps, at 600 env steps"
    assert results[0][NOTES] == [note]
    told = [report.env_steps for r in results for report in from_json_lines(r[REPORTS].encode())]
    assert told == [0, 200, 400, 600, 800, 1000], "all of it is the longer run's history"
    assert numbers(tmp_path / "b", longer) == numbers(tmp_path / "a", unbroken)
    files = [Path(NodeStore(str(tmp_path / one)).path(longer.key), "handoff") for one in "ab"]
    for array in files[0].rglob("*.safetensors"):
        assert array.read_bytes() == (files[1] / array.relative_to(files[0])).read_bytes()
    # One checkpoint, of the longest run; a later shorter run does not replace it.
    kept = store.continuation(continuation_key(longer.run, None))
    (name,) = kept.names()
    compute(job(tmp_path / "b", settings(variant, env_steps=800)))
    assert kept.names() == [name]
    assert store.work_folder(longer.key).names() == []


@pytest.mark.usefixtures("local_ray")
def test_a_damaged_or_missing_end_costs_time_and_no_number(tmp_path: Path) -> None:
    short, long = (job(tmp_path, settings("tac", env_steps=steps)) for steps in (400, 600))
    compute(short)
    kept = NodeStore(str(tmp_path)).continuation(continuation_key(short.run, None))
    (name,) = kept.names()
    (Path(kept.folder.path) / name / "history.jsonl").write_bytes(b"")
    notes = compute(long)[0][NOTES]
    assert len(notes) == 1
    assert "a damaged checkpoint is skipped" in notes[0]
    compute(job(tmp_path / "other", long.run))
    assert numbers(tmp_path, long) == numbers(tmp_path / "other", long)


@pytest.mark.usefixtures("local_ray")
def test_nothing_of_another_environment_is_continued_or_reused(tmp_path: Path) -> None:
    task = settings("tac").task
    here = dict(fingerprint_of(task.env_id, task.env_kwargs))
    driver = {"environment": here, "same_environments": frozenset({digest_of(here)})}
    old = {"environment": here | {"source point_env.py": "old"}}
    short, long, cut = (
        job(tmp_path, settings("tac", env_steps=steps)).model_copy(update=driver)
        for steps in (200, 400, 600)
    )
    compute(short)
    store = NodeStore(str(tmp_path))
    kept = store.continuation(continuation_key(short.run, None))
    assert store.environment(short.key) == kept.environment() == here
    for manifest in Path(tmp_path).rglob("manifest.json"):
        document = json.loads(manifest.read_text())
        if "environment" in document["meta"]:
            document["meta"] |= old
            manifest.write_text(json.dumps(document))
    assert (
        "its result is of another environment (point_env.py changed)" in (compute(short)[-1][CAUSE])
    )
    compute(cut, steps=2)
    work = store.work_folder(cut.key)
    assert work.environment() == here
    results = compute(long)
    assert "does not continue a finished run with fewer env_steps" in results[0][NOTES][0]
    assert from_json_lines(results[0][REPORTS].encode())[0].env_steps == 0
    with work.new_checkpoint(500, old["environment"]) as draft:
        (draft.folder / "history.jsonl").write_bytes(b"")
    assert "its checkpoint is of another environment" in compute(cut)[-1][CAUSE]
    answered = {"same_environments": frozenset(map(digest_of, (here, old["environment"])))}
    assert CAUSE not in compute(short.model_copy(update=answered))[-1]
    elsewhere = compute(cut.model_copy(update=old))
    assert "it differs from the driver's: point_env.py changed" in elsewhere[-1][CAUSE]


@pytest.mark.usefixtures("local_ray")
def test_what_is_too_large_or_not_wanted_is_not_kept(tmp_path: Path) -> None:
    node = job(tmp_path, settings("tac", env_steps=200))
    for most in (0.0, 0.001):
        compute(node.model_copy(update={"checkpoints": Checkpoints(finished_mb=most)}))
        assert not NodeStore(str(tmp_path)).existing()["continuations"]
        NodeStore(str(tmp_path)).remove(node.key)
    compute(node)
    assert NodeStore(str(tmp_path)).existing()["continuations"]


LINEAR: dict[str, Any] = {"schedule": "linear", "start": 2.0, "end": 1.0}


@pytest.mark.parametrize(
    ("changes", "spans"),
    [
        ({"entropic_index": LINEAR}, ["tac.entropic_index"]),
        ({"alpha": LINEAR}, ["tac.alpha"]),
        ({"alpha": {"value": LINEAR, "matched_width": 0.1}}, ["tac.alpha"]),
        ({"entropic_index": {"schedule": "piecewise", "points": [[0, 1.0], [300, 2.0]]}}, []),
        ({}, []),
    ],
)
def test_settings_that_span_the_budget_are_named(changes: dict[str, Any], spans: list[str]) -> None:
    run = settings("tac", env_steps=400)
    run = RunSettings.model_validate(run.model_dump() | {"tac": run.tac.model_dump() | changes})
    assert budget_settings(run) == spans
    assert is_continuable(run) == (not spans)


@pytest.mark.parametrize(
    ("env_steps", "interval", "even"),
    [(600, 200, True), (500, 200, False), (3000, 1500, True), (1500, 1500, False)],
)
def test_an_end_that_only_the_budget_requires_is_not_resumed(
    env_steps: int, interval: int, even: bool
) -> None:
    """A longer run has no evaluation, or no report, at the end of this run's budget."""
    evaluation = {"interval": interval, "episodes": 2}
    assert is_continuable(settings("tac", env_steps=env_steps, evaluation=evaluation)) == even
