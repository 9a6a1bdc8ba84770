"""The sub-commands of `python -m music_rllib.sweep`: each module here is one.

A module has `register(commands)`, which adds a parser by its name and sets its default `execute`, a
function from the parsed arguments to the exit code. It is imported for every call of the program,
so it loads nothing heavy before it is executed.
"""
