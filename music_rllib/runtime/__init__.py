"""The process and the machine: Ray clusters, signals, memory, third-party noise."""
