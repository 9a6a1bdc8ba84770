"""Reads settings: strict YAML, presets, overrides of the command line, layers of settings."""
