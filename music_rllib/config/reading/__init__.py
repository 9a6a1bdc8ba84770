"""From a file to plain settings: strict YAML, presets, overrides, and layers of settings."""
