"""Claims of a study: its primary metric, tests, the plan made before it, and the answer."""
