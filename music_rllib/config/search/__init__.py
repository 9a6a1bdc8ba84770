"""The `search` section of a stage: its settings, its space, and their checks."""
