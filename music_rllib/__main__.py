"""`python -m music_rllib`: the same as `music-rllib`."""

import sys

from music_rllib.program import main

if __name__ == "__main__":
    sys.exit(main())
