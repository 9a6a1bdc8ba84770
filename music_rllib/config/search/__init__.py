"""The `search` section of a sweep: its space, its settings, and what is checked of them."""
