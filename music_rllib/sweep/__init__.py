"""The sweeper, `python -m music_rllib.sweep`: plans, runs and reports a whole sweep with Tune."""
