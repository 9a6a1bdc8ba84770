"""A plan, a status and a comparison as tables and as plain data."""
