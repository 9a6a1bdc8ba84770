"""Learning rate schedulers of PyTorch that a user gives to RLlib, for several optimizers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ray.rllib.core.learner.torch.torch_learner import TorchLearner


def add_schedulers(learner: TorchLearner) -> None:
    """Create the schedulers of all optimizers.

    RLlib creates them in the first update, and keeps those of one optimizer for each module.
    """
    classes = learner._lr_scheduler_classes
    if classes is None:
        return
    learner._lr_schedulers = {
        module: {
            name: [make(learner.get_optimizer(module, name)) for make in own] for name in optimizers
        }
        for module, optimizers in learner._module_optimizers.items()
        for own in [classes.get(module, ()) if isinstance(classes, Mapping) else classes]
    }


def scheduler_states(learner: TorchLearner) -> dict[str, Any]:
    """The states by module and optimizer, which RLlib's checkpoints lack."""
    return {
        module: {name: [one.state_dict() for one in own] for name, own in by_name.items()}
        for module, by_name in learner._lr_schedulers.items()
    }


def load_scheduler_states(learner: TorchLearner, states: Mapping[str, Any]) -> None:
    """Load a result of `scheduler_states`; other schedulers keep their own states."""
    for module, by_name in states.items():
        for name, own in by_name.items():
            known = learner._lr_schedulers.get(module, {}).get(name, ())
            for scheduler, state in zip(known, own, strict=False):
                scheduler.load_state_dict(state)


def apply_configured_rates(learner: TorchLearner) -> None:
    """Replace the fixed learning rates of a checkpoint by those of the configuration.

    RLlib does so only after the updates of the next call. Schedules continue with their own rates.
    """
    for optimizer, schedule in learner._optimizer_lr_schedules.items():
        if not (learner._lr_schedulers or schedule.use_schedule):
            learner._set_optimizer_lr(optimizer, lr=schedule.get_current_value())
