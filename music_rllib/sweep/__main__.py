"""`python -m music_rllib.sweep`."""

from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

# Ray and MLflow read their environment while they are imported.
prepare_environment()
quiet_third_parties()

import sys  # noqa: E402

from music_rllib.sweep.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
