"""A policy's file as an MLflow model: it loads with ``mlflow.pyfunc`` and acts.

The model's folder holds the policy's own file and a script, which is a copy of
:mod:`music_rllib.policy.network` and ``MODEL_CODE``: no pickle, and nothing of this package is
needed to load it.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from music_rllib.policy import network
from music_rllib.policy.network import PolicyNetwork

__all__ = ["MODEL_NAME", "write_model"]

MODEL_NAME = "policy"
"""Name of the logged model, and of its artefact folder."""
ARTEFACT = "policy.safetensors"

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
    import mlflow.pyfunc
    from mlflow.models import Model

    policy = PolicyNetwork.from_file(file)
    with TemporaryDirectory() as temporary, _without_new_modules():
        code, artefact = Path(temporary, "policy_model.py"), Path(temporary, ARTEFACT)
        code.write_text(Path(network.__file__).read_text() + MODEL_CODE)
        shutil.copyfile(file, artefact)
        mlflow.pyfunc.save_model(
            folder,
            mlflow_model=Model(run_id=run_id, model_id=model_id),
            python_model=str(code),
            artifacts={"policy": str(artefact)},
            # No signature: it would refuse what environments give (float64, one observation, an
            # achieved goal); the policy checks sizes itself.
            signature=False,
            input_example=_example(policy),
            pip_requirements=[f"{name}=={version(name)}" for name in _REQUIREMENTS],
            metadata=_metadata(policy),
        )
    return policy


@contextlib.contextmanager
def _without_new_modules() -> Iterator[None]:
    """MLflow runs a model's code as a module of its own, and would keep one for each model."""
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name.startswith("code_model_")]:
            del sys.modules[name]


_REQUIREMENTS = ("mlflow", "numpy", "safetensors")


def _example(policy: PolicyNetwork) -> Any:
    import numpy as np

    if not policy.goal_size:
        return np.zeros((1, policy.observation_size), np.float32)
    return {
        "observation": np.zeros((1, policy.observation_size), np.float32),
        "desired_goal": np.zeros((1, policy.goal_size), np.float32),
    }


def _metadata(policy: PolicyNetwork) -> Mapping[str, Any]:
    return {"input_size": policy.input_size, "action_size": policy.action_size, **policy.about}
