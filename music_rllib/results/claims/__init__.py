"""What a study may claim: its primary metric, tests, the plan made before it, and the answer."""
