"""A sweep's YAML file: schema, layers of settings, problems and warnings."""
