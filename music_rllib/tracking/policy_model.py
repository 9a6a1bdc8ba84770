"""A policy's file as an MLflow model: it loads with ``mlflow.pyfunc`` and acts.

The model's folder holds the policy's own file and a script, which is a copy of
:mod:`music_rllib.policy.network` and ``MODEL_CODE``: no pickle, and nothing of this package is
needed to load it.
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

__all__ = ["MODEL_NAME", "write_model"]

MODEL_NAME = "policy"
"""Name of the logged model, and of its artefact folder."""
_POLICY_FILE = Path("artifacts", "policy.safetensors")
"""The policy in a model's folder."""

MODEL_CODE = '''

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
"""What follows the text of :mod:`music_rllib.policy.network` in a model's code."""


def write_model(file: Path, folder: Path, *, run_id: str, model_id: str) -> PolicyNetwork:
    """Make `folder` an MLflow model of the policy in `file`, which is returned.

    Args:
        file: the policy.
        folder: must not exist.
        run_id: MLflow's id of the run that trained it.
        model_id: MLflow's id of the logged model.

    Raises:
        PolicyFileError: the file isn't a policy.
    """
    from mlflow.models import Model
    from mlflow.models.model import MLMODEL_FILE_NAME

    policy = PolicyNetwork.from_file(file)
    for name, content in _files(policy.observation_size, policy.goal_size).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    shutil.copyfile(file, folder / _POLICY_FILE)
    described = Model.load(folder)
    size = sum(part.stat().st_size for part in folder.rglob("*") if part.is_file())
    Model(
        run_id=run_id,
        model_id=model_id,
        flavors=described.flavors,
        saved_input_example_info=described.saved_input_example_info,
        model_size_bytes=size,
        metadata=_metadata(policy),
    ).save(folder / MLMODEL_FILE_NAME)
    return policy


@functools.cache
def _files(observation_size: int, goal_size: int) -> Mapping[Path, bytes]:
    """The files of a model for observations of these sizes, its policy empty.

    MLflow runs a model's code when it saves one, and keeps what has run for as long as the process
    lives: a driver that tracks thousands of runs has it done once.
    """
    import mlflow.pyfunc

    with TemporaryDirectory() as temporary:
        code, policy = Path(temporary, "policy_model.py"), Path(temporary, _POLICY_FILE.name)
        code.write_text(Path(network.__file__).read_text() + MODEL_CODE)
        policy.touch()
        folder = Path(temporary, "model")
        mlflow.pyfunc.save_model(
            folder,
            python_model=str(code),
            artifacts={"policy": str(policy)},
            # No signature: it would refuse what environments give (float64, one observation, an
            # achieved goal); the policy checks sizes itself.
            signature=False,
            input_example=_example(observation_size, goal_size),
            pip_requirements=[f"{name}=={version(name)}" for name in _REQUIREMENTS],
        )
        files = [file for file in folder.rglob("*") if file.is_file()]
        return {file.relative_to(folder): file.read_bytes() for file in files}


_REQUIREMENTS = ("mlflow", "numpy", "safetensors")


def _example(observation_size: int, goal_size: int) -> Any:
    import numpy as np

    observation = np.zeros((1, observation_size), np.float32)
    if not goal_size:
        return observation
    return {"observation": observation, "desired_goal": np.zeros((1, goal_size), np.float32)}


def _metadata(policy: PolicyNetwork) -> dict[str, Any]:
    return {"input_size": policy.input_size, "action_size": policy.action_size, **policy.about}
