"""The plan of a sweep's runs, their scheduler, and the sweep's own files."""
