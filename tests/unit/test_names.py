"""Names that MLflow accepts, and a module that imports nothing heavy."""

from __future__ import annotations

from mlflow.utils.validation import _validate_metric_name

from music_rllib import names
from tests.processes import fresh

CONSTANTS = {
    key: value for key, value in vars(names).items() if key.isupper() and isinstance(value, str)
}


def test_mlflow_accepts_every_name() -> None:
    for value in CONSTANTS.values():
        _validate_metric_name(value)


def test_no_two_metrics_share_a_name() -> None:
    metrics = [
        value for key, value in CONSTANTS.items() if not key.startswith(("TAG_", "KIND_", "ARTIF"))
    ]
    assert len(set(metrics)) == len(metrics)


def test_names_load_neither_mlflow_nor_ray_nor_torch() -> None:
    code = (
        "import sys; import music_rllib.names, music_rllib.tracking.store; "
        "print(sorted({'mlflow', 'ray', 'torch', 'matplotlib', 'requests'} & set(sys.modules)))"
    )
    assert fresh("-c", code).stdout.strip() == "[]"
