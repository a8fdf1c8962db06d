#!/bin/sh
# A study as a Slurm array job: each task runs one of as many parts as the array has tasks.
#
#   sbatch --array=1-8 slurm.sh out/study paper --vary design.epsilon=100:10000:log9 --seeds 20
#
# Submit the same line again to continue parts that were stopped, for example by a time limit. When all
# are complete:
#
#   cat out/study/shard-*/results.csv > out/study/results.csv
#   host-sim sweep --summarise out/study/results.csv
#
# The output folder has to be on a file system that all nodes share.
#SBATCH --job-name=sweep
#SBATCH --cpus-per-task=2
#SBATCH --time=04:00:00
set -eu
folder=$1
shift
exec "${HOST_SIM:-host-sim}" sweep "$@" --out "$folder" \
    --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" \
    --threads "${SLURM_CPUS_PER_TASK:-1}"
