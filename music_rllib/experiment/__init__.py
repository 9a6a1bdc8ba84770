"""Experiments: typed configuration, the plan of nodes, their store, and handoffs between them."""
