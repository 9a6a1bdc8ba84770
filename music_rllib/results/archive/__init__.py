"""A sweep exported as plain tables: written, read, merged."""
