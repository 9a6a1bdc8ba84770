"""`python -m music_rllib.sweep`: `music-rllib` as jobs of a cluster start it.

Without a command in front, a sweep file is run; without arguments, the packaged sweep.
"""

import sys

from music_rllib.program import main

if __name__ == "__main__":
    arguments = sys.argv[1:]
    if not arguments or arguments[0].endswith((".yaml", ".yml")):
        arguments = ["run", *arguments]
    sys.exit(main(arguments, "python -m music_rllib.sweep"))
