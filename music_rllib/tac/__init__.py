"""Tsallis Actor-Critic: losses and networks (torch), and the RLlib glue around them."""
