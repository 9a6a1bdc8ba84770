"""A report that follows a sweep: its page on loopback, and what the sweep says of itself."""
