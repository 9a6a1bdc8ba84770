"""Adam, and a flat layout of parameters for it."""
