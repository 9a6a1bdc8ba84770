"""A driver in a new pod, which has only the bucket and MLflow."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer

from music_rllib import names
from tests.faults import comparison, sweeps
from tests.faults.test_dead_servers import server
from tests.integration.conftest import Program
from tests.integration.mlflow_server import MlflowServer
from tests.ports import free_port

__all__ = ["server"]

pytestmark = pytest.mark.thorough


@pytest.fixture
def bucket(program: Program) -> Iterator[str]:
    """A URI in a bucket of an S3 server that `program` can write."""
    port = free_port()
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line for each request
    own = ThreadedMotoServer("127.0.0.1", port, verbose=False)
    own.start()
    access = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing"}
    program.environment |= access
    boto3.client(
        "s3",
        endpoint_url=f"http://127.0.0.1:{port}",
        region_name="us-east-1",
        aws_access_key_id="testing",
        aws_secret_access_key="testing",
    ).create_bucket(Bucket="lab")
    place = f"endpoint_override=http://127.0.0.1:{port}&scheme=http&region=us-east-1"
    yield f"s3://lab/results?{place}"
    own.stop()


def test_a_driver_in_a_new_pod_continues(
    program: Program, unbroken: Path, bucket: str, server: MlflowServer, tmp_path: Path
) -> None:
    program.write(sweeps.document(storage=bucket, mlflow={"tracking_uri": server.uri}))
    program.environment["HOME"] = str(tmp_path / "one")
    sweeps.kill(sweeps.start_until(program, "finetune/q=1/seed0: started"))
    program.environment |= {"HOME": str(tmp_path / "two"), names.VARIABLE_REPORT: "on"}
    code, output, errors = program.run("tac.lr=0.01", command="plan")
    assert code == 0, errors
    assert "would be retrained" in output
    output = sweeps.finish(program)
    assert "pretrain/seed0: finished earlier, reused" in output
    assert comparison.logged(server.uri) == comparison.logged(f"sqlite:///{unbroken}/mlflow.db")
    (page,) = (tmp_path / "two").rglob("report.html")
    assert f"Report: {page}" in output
    assert not (program.folder / "results").exists()
