"""One run: build it from its settings, train it, save checkpoints, watch for hangs."""
