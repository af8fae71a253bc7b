#!/usr/bin/env bash
# Steps per second of every environment and of the original, measured in one run. Prints the table and also writes it to
# target/. Arguments are passed to `endless bench`.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$(cargo xtask original)
mkdir -p target/benchmarks
{
    printf '%s, %s cores, %s\n\n' "$(uname -srm)" "$(nproc)" "$(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)"
    cargo run --quiet --release -- bench --env all --original "$python" "$@"
} | tee target/benchmarks/against_original.txt
