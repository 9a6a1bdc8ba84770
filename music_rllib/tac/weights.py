"""Converts the states of the Learner's modules to arrays by network, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.core import DEFAULT_MODULE_ID

from music_rllib.tac.rl_module import ESTIMATOR_MODULE

NetworkWeights = dict[str, dict[str, NDArray[Any]]]
"""Arrays by network name and array name."""


def by_network(state: Mapping[str, Mapping[str, Any]]) -> NetworkWeights:
    """The arrays of each network, from the states of the Learner's modules."""
    weights: NetworkWeights = {}
    for name, array in state[DEFAULT_MODULE_ID].items():
        network, _, rest = name.partition(".")
        weights.setdefault(network, {})[rest or network] = np.asarray(array)
    if ESTIMATOR_MODULE in state:
        weights[ESTIMATOR_MODULE] = {
            name.removeprefix("estimator."): np.asarray(array)
            for name, array in state[ESTIMATOR_MODULE].items()
        }
    return weights


def by_module(
    weights: Mapping[str, Mapping[str, NDArray[Any]]], own: NetworkWeights
) -> dict[str, dict[str, NDArray[Any]]]:
    """The states of the Learner's modules, from the arrays of some networks.

    `own` are the current arrays of all networks. Raises ValueError for an unknown network, and for
    missing, unknown or misshapen tensors.
    """
    modules: dict[str, dict[str, NDArray[Any]]] = {}
    for network, arrays in weights.items():
        _check_same_tensors(network, own.get(network), arrays)
        module = ESTIMATOR_MODULE if network == ESTIMATOR_MODULE else DEFAULT_MODULE_ID
        prefix = "estimator" if network == ESTIMATOR_MODULE else network
        for name, array in arrays.items():
            modules.setdefault(module, {})[f"{prefix}.{name}"] = array
    return modules


def _check_same_tensors(
    network: str,
    own: Mapping[str, NDArray[Any]] | None,
    given: Mapping[str, NDArray[Any]],
) -> None:
    if own is None:
        raise ValueError(f"{network}: this algorithm has no such network")
    if own.keys() != given.keys():
        missing, unknown = sorted(own.keys() - given.keys()), sorted(given.keys() - own.keys())
        raise ValueError(
            f"{network}: tensors missing: {missing or 'none'}, unknown: {unknown or 'none'}"
        )
    for name, array in given.items():
        if array.shape != own[name].shape:
            raise ValueError(
                f"{network}.{name}: shape must be {own[name].shape}, got {array.shape}"
            )
