"""The one place that uses Ray Tune: the plan's nodes are trials of one Tune run."""
