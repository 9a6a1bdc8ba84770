"""Network weights as arrays by network, and back."""

import numpy as np

from music_rllib.tac.rl_module import states_by_module, weights_by_network


def test_weights_of_all_networks_come_back_as_they_were() -> None:
    """Also a learned alpha, which is a tensor of the module itself."""
    state = {
        "default_policy": {"log_alpha": np.array(0.5), "policy.0.weight": np.ones((2, 3))},
        "mi_estimator": {"estimator.agent.weight": np.full(4, 2.0)},
    }
    weights = weights_by_network(state)
    assert weights.keys() == {"log_alpha", "policy", "mi_estimator"}
    found = states_by_module(weights, weights)
    np.testing.assert_equal(found, state)
