"""Tasks: which environment, its horizon, and its split into agent and surrounding state."""
