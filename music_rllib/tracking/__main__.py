"""`python -m music_rllib.tracking`."""

import sys

from music_rllib.tracking.cli import main

if __name__ == "__main__":
    sys.exit(main())
