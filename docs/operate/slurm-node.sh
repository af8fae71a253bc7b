#!/bin/bash
# One trainer with its own engine, on one node.
#SBATCH --job-name=mortar
#SBATCH --nodes=1 --ntasks=1 --cpus-per-task=16 --gpus=1
#SBATCH --time=24:00:00 --signal=INT@300
#SBATCH --output=%x-%j.log

# Keeps jobs of one user on the same node apart.
export ENDLESS_GYM_ROOT="/tmp/endless-$SLURM_JOB_ID"
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" endless-train --env Endless-MortarMayhem-v0 --agent gru --environment.engine process
