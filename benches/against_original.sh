#!/usr/bin/env bash
# Steps per second of every environment, beside the original's, all measured in one run. Prints the table and keeps it under
# target/. Further arguments go to `endless bench`.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$(cargo xtask original)
mkdir -p target/benchmarks
{
    printf '%s, %s cores, %s\n\n' "$(uname -srm)" "$(nproc)" "$(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)"
    cargo run --quiet --release -- bench --env all --original "$python" "$@"
} | tee target/benchmarks/against_original.txt
