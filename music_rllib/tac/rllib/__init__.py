"""RLlib's settings, hooks and callbacks, as TAC takes them."""
