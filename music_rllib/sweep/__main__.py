"""`python -m music_rllib.sweep`."""

from music_rllib._quiet import prepare_environment, quiet_third_parties

# Ray and MLflow read their environment while they are imported.
prepare_environment()
quiet_third_parties()

from music_rllib.sweep.cli import app  # noqa: E402

if __name__ == "__main__":
    app(prog_name="python -m music_rllib.sweep")
