#!/bin/bash
# One run for each of five seeds.
#SBATCH --job-name=mortar
#SBATCH --array=1-5 --ntasks=1 --cpus-per-task=16 --gpus=1
#SBATCH --time=24:00:00 --signal=INT@300 --requeue
#SBATCH --output=%x-%A_%a.log --open-mode=append

run="runs/mortar-$SLURM_ARRAY_TASK_ID"
arguments=(--env Endless-MortarMayhem-v0 --agent gru --seed "$SLURM_ARRAY_TASK_ID" --run "$run")
# A job that was requeued or submitted again resumes its run.
if [[ -e $run/settings.json ]]; then
    arguments=(--resume "$run")
fi
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" endless-train "${arguments[@]}"
