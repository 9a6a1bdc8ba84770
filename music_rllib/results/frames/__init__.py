"""A sweep as pandas frames, wherever it is kept."""
