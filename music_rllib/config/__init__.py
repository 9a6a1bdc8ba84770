"""A sweep's YAML file: its schema, its settings layer by layer, and what is wrong with it."""
