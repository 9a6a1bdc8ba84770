"""The program `python -m music_rllib.sweep`: plans, runs and reports a whole sweep with Tune."""
