"""What Tune tells about runs, without Tune."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from music_rllib.store.history import Report, to_json_lines
from music_rllib.training.worker import NOTES, REPORTS
from music_rllib.tune.events import RESTARTS, TuneEvents


@pytest.mark.parametrize("steps, forgiven", [(500, False), (501, True)])
def test_deaths_before_progress_are_forgotten(
    steps: int, forgiven: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that dies at the same step again fails; one whose machines are reclaimed does not."""
    said: list[str] = []
    listener = SimpleNamespace(noted=lambda _, text: said.append(text), reported=lambda *_: None)
    folder = SimpleNamespace(folder=SimpleNamespace(read=lambda _: None))
    store = SimpleNamespace(work_folder=lambda _: folder)
    events = TuneEvents(SimpleNamespace(), store, [listener], tmp_path)  # type: ignore[arg-type, list-item]
    monkeypatch.setattr(events, "_node", lambda _: SimpleNamespace(key="k", label="seed0"))
    trial: Any = SimpleNamespace(run_metadata=SimpleNamespace(num_failures=0), error_file="none")

    def report(env_steps: int) -> None:
        reports = [Report(env_steps=env_steps, seconds=1, timestamp_ms=1, metrics={})]
        result = {REPORTS: to_json_lines(reports).decode(), NOTES: []}
        events.on_trial_result(iteration=0, trials=[], trial=trial, result=result)

    report(500)
    for _ in range(RESTARTS):
        trial.run_metadata.num_failures += 1
        events.on_trial_recover(trial=trial)
        report(400)
    assert f"({RESTARTS} of {RESTARTS} times)" in said[-1]
    report(steps)
    assert trial.run_metadata.num_failures == (0 if forgiven else RESTARTS)
    if forgiven:
        events.on_trial_recover(trial=trial)
        assert f"(1 of {RESTARTS} times)" in said[-1]
