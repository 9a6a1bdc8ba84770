"""One run being trained: built from its settings, advanced, checkpointed, watched."""
