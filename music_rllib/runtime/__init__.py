"""The process and the machine: Ray, signals, memory, third-party messages."""
