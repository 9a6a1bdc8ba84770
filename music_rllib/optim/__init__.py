"""Adam, and parameters that lie behind each other for it."""
