"""MLflow tracking; imports neither Ray nor the environments."""
