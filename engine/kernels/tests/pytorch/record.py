"""Write `mod.rs`: what PyTorch and `endless_gym_agents` compute from the numbers of `learning.rs`."""

from pathlib import Path

import torch
from torch import Tensor, nn

from endless_gym_agents.training import losses

CLIP_RANGE, CHOICES = 0.25, (3, 2)


def numbers(count: int, seed: int) -> Tensor:
    """As in `learning.rs`."""
    return torch.tensor([((37 * i * i + 5 * seed * i + 11 * seed) % 23 - 11) / 8 for i in range(count)])


def leaf(count: int, seed: int, *shape: int) -> Tensor:
    """Numbers with gradient."""
    return numbers(count, seed).reshape(shape).requires_grad_()


def main() -> None:
    """Compute and write."""
    recorded: dict[str, Tensor] = {}

    logits, actions = leaf(15, 5, 3, 5), torch.tensor([[2, 0], [1, 1], [0, 0]])
    log_probs = [part.log_softmax(-1) for part in logits.split(CHOICES, 1)]
    taken = torch.cat([part.gather(1, actions[:, [i]]) for i, part in enumerate(log_probs)], 1)
    entropy = -sum((part.exp() * part).sum(-1) for part in log_probs)
    outputs, given = (taken, entropy), (numbers(6, 6).view(3, 2), numbers(3, 7))
    (gradient,) = torch.autograd.grad(outputs, logits, given)
    recorded |= {"TAKEN": taken, "ENTROPY": entropy, "LOGITS": gradient}

    log_prob = leaf(16, 8, 8, 2)
    policy = losses.policy_loss(log_prob, numbers(16, 9).view(8, 2), numbers(8, 10), CLIP_RANGE)
    recorded |= {"POLICY": policy, "POLICY_GRADIENT": torch.autograd.grad(policy, log_prob)[0]}
    value = leaf(8, 11, 8)
    loss = losses.value_loss(value, numbers(8, 12), numbers(8, 13), 4 * CLIP_RANGE)
    recorded |= {"VALUE": loss, "VALUE_GRADIENT": torch.autograd.grad(loss, value)[0]}

    parameter = nn.Parameter(numbers(4, 14))
    optimizer, norms = torch.optim.AdamW([parameter], lr=0.1), []
    for update in range(3):
        parameter.grad = numbers(4, 15 + update)
        norms.append(nn.utils.clip_grad_norm_([parameter], 1.6))
        optimizer.step()
    recorded |= {"ADAMW": parameter, "NORMS": torch.stack(norms)}

    for name, shape in (("WIDE", (3, 4)), ("TALL", (4, 3))):
        q, r = torch.linalg.qr(numbers(12, 18).view(shape) if name == "TALL" else numbers(12, 18).view(shape).t())
        q = q * r.diag().sign()
        recorded[name] = 0.5 * (q if name == "TALL" else q.t())

    lines = [f"//! What PyTorch {torch.__version__.split('+')[0]} computes; written by `record.py`.\n"]
    for name, tensor in recorded.items():
        values = [float(x) for x in tensor.detach().flatten()]
        lines.append(f"pub const {name}: [f32; {len(values)}] = {[round(x, 7) + 0.0 for x in values]};")
    (Path(__file__).parent / "mod.rs").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
