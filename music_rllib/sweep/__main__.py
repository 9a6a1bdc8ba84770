"""`python -m music_rllib.sweep`: `music-rllib` as jobs of a cluster start it.

Without a command in front, a sweep file is run. Without a file, the packaged sweep is run, with
the `KEY=VALUE` settings and options that are given.
"""

import re
import sys

from music_rllib.program import main

if __name__ == "__main__":
    arguments = sys.argv[1:]
    if not arguments or re.match(r".*\.ya?ml$|[a-z][\w.]*=|-(?!h$|-help$|-version$)", arguments[0]):
        arguments = ["run", *arguments]
    sys.exit(main(arguments, "python -m music_rllib.sweep"))
