"""The plan of a sweep, its scheduler, and the record of its runs."""
