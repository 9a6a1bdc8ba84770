"""Searching for good trials with Optuna: proposals, judgement, studies. Knows no Ray."""
