"""Figures of a report: their selection for a sweep, their panels, colours and files."""
