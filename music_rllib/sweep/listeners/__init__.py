"""Who is told what happens in a sweep: the screen, MLflow, Prometheus, the state file."""
