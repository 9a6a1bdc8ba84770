"""MLflow. Knows neither Ray nor the environments."""
