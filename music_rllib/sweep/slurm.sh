set -u
if [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then
  # Network file systems and SQLite do not fit: each task has its own files, which no result needs.
  # The job after the array logs all runs and writes the report.
  scratch=$(mktemp -d)
  trap 'rm -rf "$scratch"' EXIT
  export MUSIC_RLLIB_STUDIES="$scratch" MLFLOW_TRACKING_URI="sqlite:///$scratch/mlflow.db"
  export MUSIC_RLLIB_REPORT=off
fi

"$@" "resources.num_cpus=${SLURM_CPUS_PER_TASK:-1}" &
driver=$!
# Slurm signals only this shell, so that the driver can save its runs before its Ray ends.
trap 'kill -TERM "$driver"' TERM
code=0
wait "$driver" || code=$?
while kill -0 "$driver" 2>/dev/null; do # the signal has ended the wait
  code=0
  wait "$driver" || code=$?
done
# 143: stopped before the time limit. The task goes back to the queue, and its runs are resumed.
[ "$code" -ne 143 ] || scontrol requeue "$SLURM_JOB_ID"
exit "$code"
