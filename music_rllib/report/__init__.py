"""Reports of sweeps, read from MLflow or from an exported folder, without Ray."""
