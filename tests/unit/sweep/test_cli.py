"""Bad input at the command line: exit code 2, a clear message, and nothing is started."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
import yaml

from music_rllib.command_line import console_for
from music_rllib.experiment.open_sweep import OpenSweep, open_sweep
from music_rllib.program import main
from music_rllib.sweep import driver, execution
from tests.handoffs import music_u, write_estimator
from tests.sweep_files import loaded

Document = dict[str, Any]


@dataclass
class Result:
    """Exit code and output of the program."""

    exit_code: int
    output: str
    stderr: str


Program = Callable[..., Result]

PRETRAIN: Document = {"name": "pretrain", "variant": "music-u"}


@pytest.fixture
def program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Program:
    """`music-rllib` in its own folder, up to the point where a sweep would start."""
    monkeypatch.chdir(tmp_path)

    def begun(*_: object, **__: object) -> int:
        raise AssertionError("the sweep began")

    monkeypatch.setattr(execution, "compute_and_report", begun)

    def run(document: Document | None = None, *options: str, command: str = "run") -> Result:
        arguments = list(options)
        if document is not None:
            (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(document))
            arguments = [command, "sweep.yaml", *options]
        capsys.readouterr()
        code = main(arguments)
        output, errors = capsys.readouterr()
        return Result(code, output + errors, errors)

    return run


def document(**changes: Any) -> Document:
    base: Document = {
        "name": "s",
        "tasks": ["FetchPush"],
        "resources": {"num_cpus": 1},
        "stages": [PRETRAIN],
    }
    return base | changes


def from_checkpoint(folder: Path) -> Document:
    source = {"checkpoint": str(folder)}
    return document(stages=[{"name": "f", "variant": "music-r", "init_from": source}])


def test_plan_shows_the_runs_and_leaves_nothing(program: Program, tmp_path: Path) -> None:
    result = program(document(), command="plan")
    assert result.exit_code == 0
    assert "1 run, 200,000 env steps in total." in result.output
    assert f"Storage: {tmp_path}/results" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.yaml"]


def test_options_replace_name_and_storage(program: Program, tmp_path: Path) -> None:
    result = program(document(), "--name", "other", "--storage", "elsewhere", command="plan")
    assert "Sweep other" in result.output
    assert f"Storage: {tmp_path}/elsewhere" in result.output


def test_mlflows_own_variable_stands_in_for_an_absent_setting(
    program: Program, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:planted@127.0.0.1:9")
    result = program(document(), command="plan")
    line = "MLflow: http://127.0.0.1:9, from MLFLOW_TRACKING_URI (mlflow.tracking_uri=null keeps"
    assert line in result.output
    assert "planted" not in result.output
    result = program(document())
    assert result.exit_code == 2
    assert "(from the environment variable MLFLOW_TRACKING_URI) must name an MLf" in result.stderr
    given = program(document(mlflow={"tracking_uri": "http://127.0.0.1:9"}), command="plan")
    null = program(document(), "mlflow.tracking_uri=null", command="plan")
    assert "MLFLOW_TRACKING_URI" not in given.output + null.output
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "./mlruns")
    result = program(document(), command="plan")
    assert result.exit_code == 2
    assert "MLFLOW_TRACKING_URI) must be null (an SQLite file" in result.stderr


def test_the_mlflow_file_of_a_slurm_task_is_not_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`resume` would log to a file that is deleted when the task ends."""
    config = loaded(tmp_path, document())
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri := f"sqlite:///{tmp_path}/own/mlflow.db")
    seen = driver._with_environment(console_for(), config)
    assert (seen.mlflow.tracking_uri, seen.document["mlflow"]["tracking_uri"]) == (uri, uri)
    monkeypatch.setenv("MUSIC_RLLIB_STUDIES", f"{tmp_path}/own")
    seen = driver._with_environment(console_for(), config)
    assert (seen.mlflow.tracking_uri, seen.document.get("mlflow")) == (uri, None)
    null = loaded(tmp_path, document(mlflow={"tracking_uri": None}))
    seen = driver._with_environment(console_for(), null)
    assert seen.mlflow.tracking_uri == uri, "tasks must not write one file on a shared disk"
    assert seen.document["mlflow"] == {"tracking_uri": None}


BAD: list[tuple[Document, str]] = [
    (document(colour="red"), "sweep.yaml:1: colour is not a known setting"),
    (document(resources={"num_cpus": 4096}), "resources.num_cpus must be <= "),
    (document(storage="/dev/null/x"), "/dev/null must be a writable folder"),
    (document(storage="x" * 300), "File name too long"),
    (
        document(defaults={"replay": {"capacity": 10**18}}),
        "stage pretrain: replay.capacity must fit into the memory of this machine",
    ),
    (
        document(
            tasks=["Mine", "Swing"],
            environments={
                "Mine": {"env_id": "Nope-v7", "horizon": 5},
                "Swing": {
                    "env_id": "Pendulum-v1",
                    "horizon": 200,
                    "agent_indices": [0],
                    "surrounding_indices": [3],
                    "success_key": None,
                },
            },
            stages=[{"name": "a", "variant": "tac"}],
        ),
        "environments.Mine: env_id must name an environment that can be made, got 'Nope-v7'\n"
        "environments.Swing: surrounding_indices must be < 3, the size of the observation, got 3",
    ),
]


@pytest.mark.parametrize(("bad", "message"), BAD, ids=[message[:30] for _, message in BAD])
def test_bad_input_is_refused_before_anything_starts(
    program: Program, tmp_path: Path, bad: Document, message: str
) -> None:
    for command in ("run", "plan"):
        result = program(bad, command=command)
        assert result.exit_code == 2, result.output
        assert [line for line in message.splitlines() if line not in result.stderr] == []
        assert result.stderr.startswith("error: ")
    assert not (tmp_path / "results" / "nodes").exists()


SPACE: Document = {"tac.alpha": {"float": [0.01, 0.5]}}


def searched(**search: Any) -> Document:
    of_stage = {"name": "a", "variant": "tac", "search": {"space": SPACE, "trials": 2} | search}
    return document(stages=[of_stage])


REFUSED: list[tuple[Document, str]] = [
    (
        searched(storage="postgresql://me@127.0.0.1:9/studies"),
        "search.storage must be a database that can be used, got postgresql://127.0.0.1:9",
    ),
    (
        searched(storage="sqlite:///nowhere/studies.db"),
        "search.storage must be in a folder that can be written, got sqlite:///nowhere/studies.db",
    ),
    (
        # The machine has as much, but other programs use some of it.
        document(resources={"memory_per_run": psutil.virtual_memory().total / 2**30 - 0.01}),
        "resources.memory_per_run must be <= ",
    ),
    (
        document(resources={"num_cpus": 1, "gpus_per_run": torch.cuda.device_count() + 1}),
        "resources.gpus_per_run must be <= ",
    ),
    (document(mlflow={"tracking_uri": "http://127.0.0.1:9"}), "an MLflow server that answers"),
    (from_checkpoint(Path("nowhere")), "nowhere must hold a handoff"),
]


@pytest.mark.parametrize(("bad", "message"), REFUSED, ids=[message[:30] for _, message in REFUSED])
def test_a_refused_sweep_is_not_recorded(
    program: Program, tmp_path: Path, bad: Document, message: str
) -> None:
    result = program(bad)
    assert (result.exit_code, message in result.stderr) == (2, True), result.stderr
    left = [path.name for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert not {*left} & {"config.json", "plan.json", "state.json"}
    assert not list(tmp_path.rglob("*.db"))


@pytest.mark.parametrize(
    ("bad", "message"), REFUSED[:-2], ids=[message[:30] for _, message in REFUSED[:-2]]
)
def test_a_plan_is_refused_as_its_sweep_would_be(
    program: Program, tmp_path: Path, bad: Document, message: str
) -> None:
    result = program(bad, command="plan")
    assert (result.exit_code, message in result.stderr) == (2, True), result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.yaml"]


def test_a_refused_configuration_does_not_replace_the_one_that_ran(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "compute_and_report", lambda *_, **__: 0)
    assert program(document()).exit_code == 0
    before = (tmp_path / "results/s/config.json").read_text()
    other = document(seeds=[7], mlflow={"tracking_uri": "http://127.0.0.1:9"})
    assert program(other).exit_code == 2
    assert (tmp_path / "results/s/config.json").read_text() == before


def test_files_that_are_none(program: Program, tmp_path: Path) -> None:
    result = program(None, "run", "missing.yaml")
    assert (result.exit_code, "missing.yaml: must be an existing file" in result.stderr) == (
        2,
        True,
    )
    (tmp_path / "torn.yaml").write_text("name: [")
    result = program(None, "run", "torn.yaml")
    assert (result.exit_code, "torn.yaml:1: must be valid YAML" in result.stderr) == (2, True)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:9", "RAY_ADDRESS must be HOST:PORT of a Ray cluster that answers"),
        ("http://127.0.0.1:8265", "an http address is for 'ray job submit'"),
        ("nonsense", "RAY_ADDRESS must be HOST:PORT of a Ray cluster that answers"),
    ],
)
def test_a_cluster_that_is_not_there(
    program: Program, monkeypatch: pytest.MonkeyPatch, address: str, message: str
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    result = program(document())
    assert result.exit_code == 2
    assert message in result.stderr


def test_a_damaged_node_that_others_start_from(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finetune = {"name": "f", "variant": "music-r", "init_from": "pretrain"}
    opened: list[OpenSweep] = []

    def remember(*arguments: Any, **options: Any) -> OpenSweep:
        opened.append(open_sweep(*arguments, **options))
        return opened[-1]

    monkeypatch.setattr("music_rllib.sweep.driver.open_sweep", remember)
    program(document(stages=[PRETRAIN, finetune]), command="plan")
    key = opened[-1].plan.nodes[0].key
    produced = tmp_path / "produced"
    write_estimator(produced / "handoff", music_u())
    opened[-1].store.publish(key, produced)
    node = tmp_path / "results" / "nodes" / key
    (node / "handoff" / "handoff.json").write_text("{}")
    result = program(document(stages=[PRETRAIN, finetune]))
    assert result.exit_code == 2
    assert "pretrain/seed0: " in result.stderr
    assert f"{node}/handoff/handoff.json must have " in result.stderr
    assert "--retrain-damaged" in result.stderr
    (node / "manifest.json").write_text("{}")
    result = program(document(stages=[PRETRAIN, finetune]), command="plan")
    assert result.exit_code == 2
    assert f"{node}/manifest.json must be a manifest" in result.stderr
    assert "--retrain-damaged" in result.stderr


def test_a_mistyped_option_is_bad_input(program: Program) -> None:
    result = program(document(), "--dryrun")
    assert result.exit_code == 2
    assert "No such option: --dryrun" in result.stderr
    # With the usage of the command that received it.
    result = program(None, "status", "results/s", "--nope")
    assert result.exit_code == 2
    assert result.stderr.startswith("Usage: music-rllib status ")


def test_values_of_the_command_line_are_recorded(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "compute_and_report", lambda *_, **__: 0)
    assert program(document(), "seeds=2", "env_steps=7e3").exit_code == 0
    kept = json.loads((tmp_path / "results/s/config.json").read_text())
    assert (kept["seeds"], kept["defaults"]["env_steps"]) == ([0, 1], 7000)
    result = program(None, "resume", "results/s", "--json")
    assert result.exit_code == 0
    assert "14,000 env steps" in result.output


def test_without_a_file_the_command_line_changes_the_packaged_sweep(program: Program) -> None:
    result = program(None, "plan", "seeds=2", "stages.reach.grid.tac.entropic_index=[1, 1.5, 2, 3]")
    assert result.exit_code == 0, result.stderr
    assert "No CONFIG given" in result.output
    assert "2 seeds\n  tac.entropic_index: 1, 1.5, 2, 3\n" in result.output


LONG = "x" * 300


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # An empty option is not ignored.
        (("run", "sweep.yaml", "--name", ""), "--name: name must "),
        (("plan", "sweep.yaml", "--storage", ""), "--storage: storage must not be empty"),
        (("plan", "sweep.yaml", "--seeds", ""), "--seeds must be a number of seeds"),
        (("status", "s", "--storage", ""), "--storage must not be empty, got ''"),
        (("status", "sweep.yaml", "--storage", ""), "--storage must not be empty, got ''"),
        (("evaluate", "a/seed0", "--storage", ""), "--storage must not be empty, got ''"),
        (("serve", "a/seed0", "--storage", ""), "--storage must not be empty, got ''"),
        (("status", ""), "SWEEP must not be empty, got ''"),
        (("report", "s", "--port", "0"), "--port must be given with --serve"),
        (("report", "s", "--format", "csv"), "--format must be given with --export"),
        (("plan", "sweep.yaml", "--storage", "s3://"), "storage must name a bucket"),
        (("evaluate", "s3://"), "s3:// must hold a policy: storage must name a bucket"),
        (("compare", "s3:/b/c"), "storage must name a bucket as in s3://BUCKET, got 's3:/b'"),
        (("serve", ""), "the run must not be empty, got ''"),
        (("evaluate", "x", "--storage", "s3://?region=x"), "storage must name a bucket as "),
        (("evaluate", "x", "--storage", "~nobody-at-all/x"), "storage must be in an existing home"),
        (
            ("evaluate", "x", "--storage", "sweep.yaml"),
            "--storage must be a place that can be read",
        ),
        (
            ("plan", "sweep.yaml", "--storage", "file:/x"),
            "storage must be a folder, or file:///FOLDER",
        ),
        (
            ("plan", "sweep.yaml", "--storage", "file:///x?y=1"),
            "storage must be a folder, or file:///FOLDER, got 'file:///x?y",
        ),
        (("status", "~nobody-at-all/x"), "storage must be in an existing home folder"),
        (("evaluate", f"{LONG}/seed0"), f"'{LONG}/seed0' must be a folder, or the key or label"),
        (("status", LONG), f"SWEEP must be a sweep that was started, got {LONG}"),
        (("status", f"{LONG}/s"), "/"),  # the path, and that its name is too long
    ],
)
def test_an_option_or_place_that_cannot_be_is_bad_input(
    program: Program, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(document()))
    result = program(None, *arguments)
    assert (result.exit_code, result.stderr.startswith(f"error: {message}")) == (2, True), (
        result.stderr
    )


@pytest.mark.parametrize("value", ["nan", "inf", "-1", "1e300", "soon"])
@pytest.mark.parametrize(
    "option",
    ["run --wait-for-nodes", "resume --wait-for-nodes", "status --interval", "stop --wait"],
)
def test_a_time_that_no_clock_can_measure_is_refused(
    program: Program, option: str, value: str
) -> None:
    command, name = option.split()
    result = program(None, command, "results/s", name, value)
    assert result.exit_code == 2
    assert result.stderr.endswith(
        f"Invalid value for '{name}': must be a number from 0 to 1,000,000, got {value}\n"
    ), result.stderr


def test_resume_needs_a_sweep(program: Program, tmp_path: Path) -> None:
    (tmp_path / "results/s").mkdir(parents=True)
    result = program(None, "resume", str(tmp_path / "results/s"))
    assert result.exit_code == 2
    assert "SWEEP must be a sweep that was started" in result.stderr
    (tmp_path / "results/s/sweep.json").write_text("{}")
    result = program(None, "compare", str(tmp_path / "results/s"))
    assert "an exported sweep: `music-rllib report` shows it" in result.stderr


def test_a_storage_or_sweep_in_place_of_what_it_contains(program: Program, tmp_path: Path) -> None:
    (tmp_path / "results/s").mkdir(parents=True)
    (tmp_path / "results/s/plan.json").write_text("{}")
    result = program(None, "compare", "results")
    assert "got results, a storage with the sweeps s\n" in result.stderr
    result = program(None, "evaluate", "results/s")
    assert "results/s must hold a policy, and is a sweep" in result.stderr


def test_a_folder_that_is_not_there(program: Program, tmp_path: Path) -> None:
    result = program(None, "status", str(tmp_path / "empty"))
    assert result.exit_code == 2
    assert f"got {tmp_path}/empty: there is no {tmp_path}/empty/config.json (" in result.stderr
