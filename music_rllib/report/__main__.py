"""`python -m music_rllib.report SWEEP`: one page about a sweep."""

from __future__ import annotations

import sys

from music_rllib.runtime.quiet import prepare_environment, quiet_third_parties

if __name__ == "__main__":
    prepare_environment()
    quiet_third_parties()
    from music_rllib.report.cli import main

    sys.exit(main())
