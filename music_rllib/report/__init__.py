"""Reports of sweeps, read from their storage or from an exported folder, without Ray."""
