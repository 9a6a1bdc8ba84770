"""The live page: a report of a running sweep, served on loopback with the sweep's progress."""
