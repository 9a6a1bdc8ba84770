"""The commands of a sweep: each module has a function and the examples of its help.

A module is imported for every call of the program, so it loads nothing heavy before it is called.
"""
