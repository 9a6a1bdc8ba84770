"""Results of sweeps: runs, statistics, verdicts, exports."""
