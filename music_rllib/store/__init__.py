"""What outlasts a process: finished runs, handoffs, leases, a sweep's own files."""
