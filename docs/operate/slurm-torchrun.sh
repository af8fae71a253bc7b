#!/bin/bash
# One data-parallel run on two nodes with four GPUs each.
#SBATCH --job-name=mortar
#SBATCH --nodes=2 --ntasks-per-node=1 --gpus-per-node=4 --cpus-per-task=64
#SBATCH --time=24:00:00
#SBATCH --output=%x-%j.log

head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
# Jobs that share a node need different ports.
port=$((20000 + SLURM_JOB_ID % 10000))
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" torchrun --nnodes="$SLURM_NNODES" --nproc-per-node=4 --max-restarts=3 \
    --rdzv-backend=c10d --rdzv-endpoint="$head:$port" --rdzv-id="$SLURM_JOB_ID" \
    -m endless_gym_agents.train -- --env Endless-MortarMayhem-v0 --agent trxl --environment.num-envs 256 --run runs/mortar
