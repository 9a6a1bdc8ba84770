"""Sweeps: commands, driver, listeners, tables."""
