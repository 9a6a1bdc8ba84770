"""MUSIC's mutual-information estimator: network, loss and intrinsic reward (pure torch)."""
