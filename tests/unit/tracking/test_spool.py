"""The spool: nothing lost, nothing twice, whatever the moment of the cut."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from music_rllib.errors import TrackingError
from music_rllib.tracking.spool import (
    Delivered,
    Finish,
    Metrics,
    Record,
    Spool,
    Start,
    has_undelivered,
)

START = Start(time=1, name="run", tags={"task": "FetchPush"}, params={"q": "1.5"})


def metrics(step: int, **values: float) -> Metrics:
    return Metrics(time=1000 + step, step=step, values=values or {"a": float(step)})


def records(spool: Spool) -> list[Record]:
    return [record for record, _ in spool.read(0)]


def test_records_come_back_as_they_were_written(tmp_path: Path) -> None:
    written: list[Record] = [
        START,
        metrics(2, a=0.1, b=-1e300),
        Finish(time=9, status="FAILED", tags={"f": "é"}),
    ]
    Spool(tmp_path).append(written)
    assert records(Spool(tmp_path)) == written


def test_nan_and_infinity_survive(tmp_path: Path) -> None:
    Spool(tmp_path).append([metrics(1, a=math.nan, b=math.inf)])
    (record,) = Spool(tmp_path).history()
    assert math.isnan(record.values["a"])
    assert record.values["b"] == math.inf


def test_a_step_that_is_repeated_after_a_resume_is_left_out(tmp_path: Path) -> None:
    first = Spool(tmp_path)
    first.append([START, metrics(2000), metrics(4000)])
    again = Spool(tmp_path)
    again.append([START])
    for step in (2000, 4000, 6000):
        again.append([metrics(step, a=7.0)])
    assert [(record.step, record.values) for record in again.history()] == [
        (2000, {"a": 2000.0}),
        (4000, {"a": 4000.0}),
        (6000, {"a": 7.0}),
    ]


def test_a_metric_that_comes_later_at_the_same_step_is_kept(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append([metrics(5, a=1.0), metrics(5, a=2.0, b=3.0)])
    assert [record.values for record in spool.history()] == [{"a": 1.0}, {"b": 3.0}]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), steps=st.lists(st.integers(1, 10_000), min_size=1, max_size=8, unique=True))
def test_a_cut_at_any_byte_loses_only_what_is_logged_again(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, steps: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("spool")
    every: list[Record] = [START, *(metrics(step) for step in sorted(steps))]
    spool = Spool(folder)
    spool.append(every)
    whole = spool.path.read_bytes()
    spool.path.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])

    again = Spool(folder)
    survived = records(again)
    assert survived == every[: len(survived)]
    again.append(every[1 if again.start else 0 :])
    assert records(again) == every
    assert again.path.read_bytes() == whole


def test_reading_stops_before_a_line_that_is_still_being_written(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append([START, metrics(1)])
    with spool.path.open("ab") as file:
        file.write(b'{"kind": "metrics", "time": 5')
    assert len(records(spool)) == 2


def test_a_damaged_line_does_not_hide_the_rest(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = Spool(tmp_path)
    spool.append([START, metrics(1)])
    with spool.path.open("ab") as file:
        file.write(b"\x00\x00garbage\n")
    again = Spool(tmp_path)
    again.append([metrics(2)])
    assert [record.step for record in again.history()] == [1, 2]
    assert str(again.path) in caplog.text


def test_the_delivered_offset_is_remembered(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append([START, metrics(1), metrics(2)])
    ends = [end for _, end in spool.read(0)]
    spool.set_delivered(Delivered(run_id="r", offset=ends[1], records=2))
    again = Spool(tmp_path)
    assert again.undelivered == 1
    assert [record for record, _ in again.read(again.delivered.offset)] == [metrics(2)]
    assert has_undelivered(tmp_path)
    again.set_delivered(Delivered(run_id="r", offset=ends[2], records=3))
    assert not has_undelivered(tmp_path)


@pytest.mark.parametrize("content", ["", "{", '{"offset": 999999}', '{"unknown": 1}', "[]"])
def test_a_bad_delivered_file_means_deliver_again(tmp_path: Path, content: str) -> None:
    Spool(tmp_path).append([START])
    (tmp_path / "delivered.json").write_text(content)
    assert Spool(tmp_path).undelivered == 1


def test_an_artefact_that_is_replaced_during_its_upload_is_sent_again(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.put_artefact("config/run.yaml", "old")
    sent = []

    def upload(file: Path) -> None:
        sent.append(file.read_text())
        if len(sent) == 1:
            spool.put_artefact("config/run.yaml", "new")

    spool.send_artefact("config/run.yaml", upload)
    assert spool.queued_artefacts() == ["config/run.yaml"]
    spool.send_artefact("config/run.yaml", upload)
    assert spool.queued_artefacts() == []
    assert sent == ["old", "new"]


def test_an_artefact_cannot_leave_the_runs_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must stay inside"):
        Spool(tmp_path / "run").put_artefact("../../stolen", "x")


def test_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(TrackingError, match=r"file/run/spool\.jsonl must be writable"):
        Spool(tmp_path / "file" / "run")


def test_a_full_disk_is_named_and_the_spool_stays_whole(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append([START, metrics(1)])
    kept = spool.path
    spool.path = Path("/dev/full")
    with pytest.raises(TrackingError, match=r"/dev/full must be writable.*No space left"):
        spool.append([metrics(2)])
    spool.path = kept
    spool.append([metrics(2)])
    assert [record.step for record in spool.history()] == [1, 2]
