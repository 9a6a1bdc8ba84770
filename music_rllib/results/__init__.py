"""Statistics and claims of a sweep's runs, in numbers and in sentences; loads no Ray."""
