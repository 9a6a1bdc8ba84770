"""Searches with Optuna: points, studies, the value of a trial, early stopping. Imports no Ray."""
