"""Act in environments of an engine process with a jitted recurrent policy in JAX, on frames that stay in shared memory.

pip install ./bindings/python jax
python jax_service.py --env-id Endless-MortarMayhem-v0 --num-envs 256 --total-timesteps 100000

On the CPU, `jax.device_put(observation, may_alias=True)` returns an array over the memory that the engine wrote, whereas
`jax.numpy.asarray` would copy the batch. On a GPU or TPU the same call makes the only copy to the device.
"""

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import endless_gym

Parameters = dict[str, Any]
FILTERS = [(16, 8, 4), (32, 4, 2)]  # output channels, size and stride of the convolutions


def as_jax(observation: Any) -> Any:
    """The observation, an array or a dict of arrays, as read-only JAX arrays over the same memory if the device can read it.

    A JAX array keeps its batch alive, and an engine lends only `batches_held` batches at a time, so do not keep the arrays.
    """
    return jax.device_put(observation, may_alias=True)


def init(key: jax.Array, observation: Any, choices: tuple[int, ...], hidden_size: int) -> Parameters:
    """Random weights for the observations of an environment and the numbers of choices of its action branches."""

    def dense(key: jax.Array, inputs: int, outputs: int, scale: float = 1.0) -> Parameters:
        return {"w": jax.random.normal(key, (inputs, outputs)) * scale * inputs**-0.5, "b": jnp.zeros(outputs)}

    keys = iter(jax.random.split(key, len(FILTERS) + 2 + len(choices)))
    convolutions, channels = [], 3
    for outputs, size, _ in FILTERS:
        shape, scale = (size, size, channels, outputs), (size * size * channels) ** -0.5
        convolutions.append(jax.random.normal(next(keys), shape) * scale)
        channels = outputs
    width = encode(convolutions, observation).shape[-1]
    return {
        "convolutions": convolutions,
        "input": dense(next(keys), width, 3 * hidden_size),
        "hidden": dense(next(keys), hidden_size, 3 * hidden_size),
        "heads": [dense(next(keys), hidden_size, n, 0.01) for n in choices],
    }


def encode(convolutions: list[jax.Array], observation: Any) -> jax.Array:
    """Frames uint8 (n, 84, 84, 3), and the vector observation if there is one, as float32 (n, width)."""
    is_dict = isinstance(observation, dict)
    x = (observation["visual_observation"] if is_dict else observation).astype(jnp.float32) / 255
    for kernel, (_, _, stride) in zip(convolutions, FILTERS, strict=True):
        x = jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = jax.nn.relu(x)
    parts = [x.reshape(len(x), -1)] + ([observation["vector_observation"]] if is_dict else [])
    return jnp.concatenate(parts, axis=-1)


@jax.jit
def act(
    parameters: Parameters, observation: Any, hidden: jax.Array, start: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sample the actions of all environments.

    Args:
        parameters: Weights, of `init`.
        observation: Frames uint8 (n, 84, 84, 3), or a dict of arrays.
        hidden: State of the GRU, float32 (n, hidden_size).
        start: Whether the observation is the first of an episode, bool (n,).
        key: Key of the random numbers.

    Returns:
        Actions int32 (n, branches), the next state of the GRU, and the next key.
    """
    key, *keys = jax.random.split(key, 1 + len(parameters["heads"]))
    hidden = jnp.where(start[:, None], 0.0, hidden)
    x = encode(parameters["convolutions"], observation) @ parameters["input"]["w"] + parameters["input"]["b"]
    h = hidden @ parameters["hidden"]["w"] + parameters["hidden"]["b"]
    (xr, xz, xn), (hr, hz, hn) = jnp.split(x, 3, axis=-1), jnp.split(h, 3, axis=-1)
    update = jax.nn.sigmoid(xz + hz)
    candidate = jnp.tanh(xn + jax.nn.sigmoid(xr + hr) * hn)
    hidden = (1 - update) * candidate + update * hidden
    actions = [
        jax.random.categorical(key, hidden @ head["w"] + head["b"])
        for key, head in zip(keys, parameters["heads"], strict=True)
    ]
    return jnp.stack(actions, axis=-1).astype(jnp.int32), hidden, key


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="Endless-MortarMayhem-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=64, help="number of environments")
    parser.add_argument("--total-timesteps", type=int, default=100_000, help="environment steps in total")
    parser.add_argument("--hidden-size", type=int, default=128, help="size of the GRU's state")
    parser.add_argument("--seed", type=int, default=1, help="seed of the environments, the network and the actions")
    args = parser.parse_args()

    with endless_gym.serve(args.env_id, num_envs=args.num_envs, autoreset="same_step") as envs:
        discrete = not hasattr(envs.single_action_space, "nvec")
        choices = (envs.single_action_space.n,) if discrete else tuple(envs.single_action_space.nvec)
        observation, _ = envs.reset(seed=args.seed)
        frames = observation["visual_observation"] if isinstance(observation, dict) else observation
        shared = jax.tree.leaves(as_jax(frames))[0].unsafe_buffer_pointer() == frames.ctypes.data
        key, init_key = jax.random.split(jax.random.key(args.seed))
        parameters = init(init_key, observation, choices, args.hidden_size)
        hidden, start = jnp.zeros((args.num_envs, args.hidden_size)), np.ones(args.num_envs, dtype=bool)
        print(f"device={jax.devices()[0]} observation={frames.shape} {frames.dtype} shared={shared}")

        steps, returns = 0, []
        begin = time.perf_counter()
        while steps < args.total_timesteps:
            actions, hidden, key = act(parameters, as_jax(observation), hidden, start, key)
            actions = np.asarray(actions)  # waits for the policy
            observation, _, terminated, truncated, info = envs.step(actions[:, 0] if discrete else actions)
            start = terminated | truncated
            steps += args.num_envs
            if "final_info" in info:
                returns += info["final_info"]["reward"][info["_final_info"]].tolist()
        seconds = time.perf_counter() - begin

    mean = f"{sum(returns) / len(returns):.3f}" if returns else "none yet"
    print(f"steps={steps} steps_per_second={steps / seconds:.0f} episodes={len(returns)} mean_return={mean}")


if __name__ == "__main__":
    main()
