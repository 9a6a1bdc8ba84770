"""Replay of whole trajectories, with two views: transitions for TAC, trajectories for MUSIC."""
