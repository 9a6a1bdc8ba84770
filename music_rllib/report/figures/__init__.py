"""Figures of a report: their choice, subplots, colors and files."""
