"""The one place that knows Ray Tune: the plan's nodes as trials of one Tune run."""
