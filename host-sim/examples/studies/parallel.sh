#!/bin/sh
# A study with GNU parallel: as many parts as the first argument says, one thread each.
#
#   ./parallel.sh 8 out/study paper --vary design.epsilon=100:10000:log9 --seeds 20
#
# Run the same line again to continue after an interruption. For several machines that share the
# output folder, add --sshlogin or --sshloginfile to PARALLEL_OPTIONS, with --workdir .
set -eu
parts=$1 folder=$2
shift 2
program=${HOST_SIM:-host-sim}
# --quote: what the options of a sweep contain, such as brackets, is not for the shell.
seq "$parts" | parallel --quote --halt soon,fail=1 ${PARALLEL_OPTIONS:-} \
    "$program" sweep "$@" --out "$folder" --shard "{}/$parts" --threads 1
cat "$folder"/shard-*/results.csv > "$folder/results.csv"
"$program" sweep --summarise "$folder/results.csv"
