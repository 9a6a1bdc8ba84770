"""The page's template, style and scripts, its tables and the data that its scripts draw."""
