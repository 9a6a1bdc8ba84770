"""The commands of a sweep, a module each: its function and the examples of its help.

A module is imported for every call of the program, so it loads nothing heavy before it is called.
"""
