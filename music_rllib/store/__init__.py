"""Storage in a folder or a bucket: finished runs, checkpoints, handoffs and leases."""
