"""TAC's updates and MUSIC's estimator, compiled for a CPU, with derivatives written by hand.

Formulas are in `music_rllib.functional`, under the same file names, and autograd is their
reference. The package has no networks: callers pass flat arrays of parameters.
"""
