#!/bin/sh
# Drivers of one sweep as a job array. They share the runs through the storage, without a Ray cluster:
#   sbatch --array=1-8 --time=12:00:00 --cpus-per-task=16 --job-name=q-sweep \
#     cluster/slurm.sh my_sweep.yaml --storage /shared/results
# 'music-rllib' must be on the PATH. docs/slurm.md has the rest.
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=%x-%A_%a.log
set -u
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
# Network file systems and SQLite do not fit: each driver has its own files, which no result needs.
export MUSIC_RLLIB_STUDIES="$scratch" MLFLOW_TRACKING_URI="sqlite:///$scratch/mlflow.db"

music-rllib run "$@" "resources.num_cpus=${SLURM_CPUS_PER_TASK:-1}" &
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
