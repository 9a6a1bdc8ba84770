"""`python -m music_rllib.serve`."""

from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

# Ray reads its environment while it is imported.
prepare_environment()
quiet_third_parties()

import sys  # noqa: E402

from music_rllib.serve.command import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
