"""Observation transforms: the paper's naive baselines, which extend the observation instead of adding a memory.

A transform turns the environments' observation into the agent's: unchanged, with the last grey frames stacked, or with the
encoded step number of the episode. It has a state between steps, as a memory does; see `memory`.
"""

from __future__ import annotations

from typing import TypeAlias

import torch
from torch import Tensor

from endless_gym_agents.agent.encoders import FRAME, Observation, Shapes

#: Entries of the encoded step number, and the number of distinct encodings.
POSITION_WIDTH, POSITIONS = 16, 512
#: Key of the encoded step number in the observation.
POSITION = "position"


#: State of a transform for n environments between two steps: tensors (n, ...) by name.
TransformState: TypeAlias = dict[str, Tensor]


class ObservationTransform:
    """Turns the environments' observation into the agent's; this one leaves it unchanged.

    Attributes:
        shapes: Shapes of the agent's observation.
    """

    def __init__(self, shapes: Shapes) -> None:
        """Make the transform for observations of these shapes."""
        self.shapes = shapes

    def initial_state(self, num_envs: int) -> TransformState:
        """The state of `num_envs` environments before their first step."""
        return {}

    def apply(
        self, observation: Observation, state: TransformState, reset_mask: Tensor
    ) -> tuple[Observation, TransformState]:
        """Transform one observation of n environments without changing the state.

        Args:
            observation: The environments' observation.
            state: State of the same environments.
            reset_mask: Whether the observation is the first of an episode, bool (n,).

        Returns:
            The agent's observation, and the state after this step.
        """
        return observation, {}


class FrameStack(ObservationTransform):
    """Stacks the last `count` observations along the last axis, oldest first; frames are converted to grey.

    The first observation of an episode fills the whole stack.
    """

    def __init__(self, shapes: Shapes, count: int, device: torch.device) -> None:
        """Make the transform.

        Args:
            shapes: Shapes of one environment's observation.
            count: Number of stacked observations.
            device: Device of the state.
        """
        self.count, self.device = count, device
        self.single = {key: (*shape[:-1], 1) if key == FRAME else shape for key, shape in shapes.items()}
        self.shapes = {key: (*shape[:-1], shape[-1] * count) for key, shape in self.single.items()}

    def initial_state(self, num_envs: int) -> TransformState:
        return {
            key: torch.zeros(
                (num_envs, *shape), dtype=torch.uint8 if key == FRAME else torch.float32, device=self.device
            )
            for key, shape in self.shapes.items()
        }

    def apply(
        self, observation: Observation, state: TransformState, reset_mask: Tensor
    ) -> tuple[Observation, TransformState]:
        stacks = {}
        for key, newest in observation.items():
            newest = grey(newest) if key == FRAME else newest
            shifted = torch.cat([state[key][..., self.single[key][-1] :], newest], dim=-1)
            filled = newest.repeat(*(1 for _ in newest.shape[:-1]), self.count)
            stacks[key] = torch.where(reset_mask.view(-1, *(1 for _ in newest.shape[1:])), filled, shifted)
        return stacks, stacks


class PositionalEncoding(ObservationTransform):
    """Adds the sinusoidal encoding of the step number in the episode, under the key `position`, float32 (n, 16).

    All steps from number 511 on have the same encoding.
    """

    def __init__(self, shapes: Shapes, device: torch.device) -> None:
        """Make the transform for observations of these shapes; `device` is the device of the state."""
        self.shapes = {**shapes, POSITION: (POSITION_WIDTH,)}
        self.device = device
        steps = torch.arange(POSITIONS, dtype=torch.float64).unsqueeze(1)
        angles = steps / 1e4 ** (torch.arange(0, POSITION_WIDTH, 2) / POSITION_WIDTH)
        # Sine and cosine of each frequency alternate.
        self.table = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1).float().to(device)

    def initial_state(self, num_envs: int) -> TransformState:
        return {"next": torch.zeros(num_envs, dtype=torch.long, device=self.device)}

    def apply(
        self, observation: Observation, state: TransformState, reset_mask: Tensor
    ) -> tuple[Observation, TransformState]:
        position = state["next"].masked_fill(reset_mask, 0)
        encoded = self.table[position.clamp(max=POSITIONS - 1)]
        return {**observation, POSITION: encoded}, {"next": position + 1}


def grey(frames: Tensor) -> Tensor:
    """Luminance (ITU-R BT.601) of frames uint8 (..., 3) as uint8 (..., 1), in integer arithmetic."""
    red, green, blue = frames.int().unbind(-1)
    return ((4899 * red + 9617 * green + 1868 * blue + 8192) >> 14).to(torch.uint8).unsqueeze(-1)
