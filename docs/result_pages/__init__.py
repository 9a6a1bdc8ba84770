"""The tables and figures of docs/results.md and its appendix (generate_results.py)."""
