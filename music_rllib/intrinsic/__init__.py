"""Intrinsic rewards: their interface, and MUSIC's with its mutual-information estimator."""
