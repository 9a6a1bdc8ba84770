"""A policy as an MLflow model that `mlflow.pyfunc` loads, without a pickle or this package.

The model's folder holds the policy's file and a script, which is a copy of
:mod:`music_rllib.policy.network` followed by `_MODEL_CODE`.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from music_rllib.policy import network
from music_rllib.policy.network import PolicyNetwork

MODEL_NAME = "policy"
"""Name of the logged model, and of its artifact folder."""
_POLICY_FILE = Path("artifacts", "policy.safetensors")
"""Path of the policy in the model's folder."""

_MODEL_CODE = '''

import mlflow


class PolicyModel(mlflow.pyfunc.PythonModel):
    """A trained policy: `predict` takes observations and returns actions."""

    def load_context(self, context):
        self.policy = PolicyNetwork.from_file(Path(context.artifacts["policy"]))

    def predict(self, context, model_input: np.ndarray, params=None):
        """Observations, single or batched, as a dictionary, an array or a table -> actions."""
        if hasattr(model_input, "columns"):
            model_input = self._from_table(model_input)
        return self.policy.act(model_input)

    def _from_table(self, table):
        """A row is an observation: a column per feature, or columns that hold lists."""
        if "observation" not in table.columns:
            return table.to_numpy(dtype=np.float32)
        parts = [name for name in ("observation", "desired_goal") if name in table.columns]
        return {name: np.stack(table[name].to_list()) for name in parts}


mlflow.models.set_model(PolicyModel())
'''


def write_model(file: Path, folder: Path, *, run_id: str, model_id: str) -> PolicyNetwork:
    """Write an MLflow model of the policy in `file` to a new folder, and return the policy.

    Raises:
        PolicyFileError: The file is not a policy.
    """
    from mlflow.models import Model
    from mlflow.models.model import MLMODEL_FILE_NAME

    policy = PolicyNetwork.from_file(file)
    for name, content in _files(policy.observation_size, policy.goal_size).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    shutil.copyfile(file, folder / _POLICY_FILE)
    description = Model.load(folder)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    Model(
        run_id=run_id,
        model_id=model_id,
        flavors=description.flavors,
        saved_input_example_info=description.saved_input_example_info,
        model_size_bytes=size,
        metadata={
            "input_size": policy.input_size,
            "action_size": policy.action_size,
            **policy.about,
        },
    ).save(folder / MLMODEL_FILE_NAME)
    return policy


@functools.cache
def _files(observation_size: int, goal_size: int) -> Mapping[Path, bytes]:
    """The files of a model for observations of these sizes, with an empty policy.

    Cached because MLflow runs a model's code when it saves the model, and keeps it in memory for
    as long as the process lives; a driver may track thousands of runs.
    """
    import mlflow.pyfunc
    import numpy as np

    example: Any = np.zeros((1, observation_size), np.float32)
    if goal_size:
        goal = np.zeros((1, goal_size), np.float32)
        example = {"observation": example, "desired_goal": goal}
    with TemporaryDirectory() as temporary:
        code, policy = Path(temporary, "policy_model.py"), Path(temporary, _POLICY_FILE.name)
        code.write_text(Path(network.__file__).read_text(encoding="utf-8") + _MODEL_CODE)
        policy.touch()
        folder = Path(temporary, "model")
        requirements = [f"{name}=={version(name)}" for name in ("mlflow", "numpy", "safetensors")]
        mlflow.pyfunc.save_model(
            folder,
            python_model=str(code),
            artifacts={"policy": str(policy)},
            # No signature: it would refuse observations of environments, such as float64 numbers,
            # single ones, or with an achieved goal. The policy checks sizes itself.
            signature=False,
            input_example=example,
            pip_requirements=requirements,
        )
        files = [file for file in folder.rglob("*") if file.is_file()]
        return {file.relative_to(folder): file.read_bytes() for file in files}
