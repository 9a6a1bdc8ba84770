"""Listeners to the events of a sweep: the screen, MLflow, Prometheus, the state file."""
