"""Records what numpy's SeedSequence and Generator(PCG64) give, as JSON on standard output.

    python record_random.py > cases.json
    python record_random.py --streams 2000 --draws 400 > wide.json    # a wider run, not stored

numpy 1.26 and 2.x write the same cases; the tail of the normal distribution depends on the logarithm
of the C library. The file holds only integers: floats are stored as the 64 bits of their IEEE 754 form,
which avoids decimal conversions.
"""

import argparse
import json
import random
import struct

import numpy as np

EDGE_SEEDS = [0, 1, 2**31, 2**32 - 1, 2**32, 2**63, 2**64 - 1]

# Ranges that the environments draw from.
GAME_RANGES = [
    (0, 1), (0, 2), (0, 3), (2, 4), (1, 9), (0, 5), (0, 25), (0, 36), (0, 84), (0, 100),
    (0, 360), (-45, 45), (-135, 135), (-8, 8), (-2, 2), (7, 14), (30, 56),
]
# Ranges around the limits of numpy's methods, and ranges that reject often.
EDGE_RANGES = [
    (0, 2**31 - 1), (0, 2**31), (0, 2**31 + 1), (-7, 3 * 2**30), (0, 2**32 - 2),
    (0, 2**32 - 1), (-5, 2**32 - 5), (0, 2**32), (-(2**31), 2**31), (0, 2**32 + 1), (-3, 2**32),
    (0, 2**33), (-(2**40), 2**50 + 12345), (0, 2**62 + 1), (-(2**62) - 1, 2**62), (0, 2**63 - 1),
    (-(2**63), 0), (-(2**63), 2**63 - 1), (-(2**63) + 1, 2**63 - 1), (2**63 - 3, 2**63 - 1),
    (-(2**63), -(2**63) + 1), (5, 6), (-1, 0),
]
NORMALS = [(0.0, 1.0), (0.0, 0.1), (0.0, 0.3), (-2.5, 1e-3), (1e300, 0.0)]
UNIFORMS = [
    (0.0, 1.0), (-1.0, 1.0), (0.0025, 0.0075), (0.002, 0.005), (3.25, 3.25), (-1e300, 1e300 / 3),
    (0.1, 0.3), (1e-310, 3e-310), (0.0, 360.0),
]


def bits(value):
    return struct.unpack("<Q", struct.pack("<d", float(value)))[0]


def words(value):
    """The little-endian 32-bit words of an integer, as SeedSequence splits it."""
    result = [value & 0xFFFFFFFF]
    while value := value >> 32:
        result.append(value & 0xFFFFFFFF)
    return result


def seeding(entropy, spawn_key=()):
    sequence = np.random.SeedSequence(entropy, spawn_key=spawn_key)
    return {
        "entropy": words(entropy) if isinstance(entropy, int) else entropy,
        "spawn_key": list(spawn_key),
        "u32": sequence.generate_state(9, np.uint32).tolist(),
        "u64": sequence.generate_state(5, np.uint64).tolist(),
    }


def random_range(picker):
    """A non-empty half-open range of any magnitude within int64."""
    while True:
        low, high = sorted(
            picker.choice((-1, 1)) * picker.getrandbits(picker.randint(1, 63)) for _ in range(2)
        )
        if low < high:
            return low, high


def integers(rng, picker):
    low, high = picker.choices(
        (picker.choice(GAME_RANGES), picker.choice(EDGE_RANGES), random_range(picker)), (5, 4, 2)
    )[0]
    size = picker.choices((None, 1, 2, 3, 5), (8, 1, 2, 1, 1))[0]
    # numpy truncates float arguments.
    exact = max(abs(low), abs(high)) < 2**31
    as_float = exact and picker.random() < 0.2
    drawn = rng.integers(float(low), float(high), size) if as_float else rng.integers(low, high, size)
    return {"integers": [low, high, np.atleast_1d(drawn).tolist()]}


def draw(rng, picker):
    kinds = {"integers": 12, "choice": 3, "uniform": 2, "random": 2}
    kinds |= {"random_f32": 2, "normal": 3, "shuffle": 1, "distinct": 1}
    kind = picker.choices(list(kinds), list(kinds.values()))[0]
    if kind == "integers":
        return integers(rng, picker)
    if kind == "choice":
        length = picker.choice((1, 2, 3, 4, 8, 100, 1000))
        return {"choice": [length, int(rng.choice(list(range(length))))]}
    if kind == "uniform":
        low, high = picker.choice(UNIFORMS)
        return {"uniform": [bits(low), bits(high), bits(rng.uniform(low, high))]}
    if kind == "random_f32":
        return {"random_f32": int(np.float32(rng.random(dtype=np.float32)).view(np.uint32))}
    if kind == "normal":
        mean, deviation = picker.choice(NORMALS)
        return {"normal": [bits(mean), bits(deviation), bits(rng.normal(mean, deviation))]}
    if kind == "shuffle":
        items = np.arange(picker.choice((0, 1, 2, 3, 16, 17, 52)))
        rng.shuffle(items)
        return {"shuffle": items.tolist()}
    if kind == "distinct":
        count = picker.choice((1, 2, 16, 36, 64))
        size = picker.choice((0, 1, count // 6, count // 2, count))
        return {"distinct": [count, rng.choice(count, size, replace=False).tolist()]}
    return {"random": bits(rng.random())}


def normals(rng, count):
    """A checksum of so many standard normals that all branches of the ziggurat occur."""
    checksum = 0
    for number in rng.standard_normal(count):
        checksum = (checksum << 1 | checksum >> 63) & 0xFFFFFFFFFFFFFFFF ^ bits(number)
    return {"normals": [count, checksum]}


def stream(seed, spawn_key, count, picker):
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=spawn_key)))
    draws = [draw(rng, picker) for _ in range(count)]
    draws.append(normals(rng, 20_000))
    # One draw of each kind at the end checks the state and the kept half after the last draw.
    draws.append({"integers": [0, 2**32, [int(rng.integers(0, 2**32))]]})
    draws.append({"random": bits(rng.random())})
    return {"seed": seed, "spawn_key": list(spawn_key), "draws": draws}


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--streams", type=int, default=24)
    arguments.add_argument("--draws", type=int, default=70)
    arguments = arguments.parse_args()
    picker = random.Random(20240229)

    seeds = list(EDGE_SEEDS)
    while len(seeds) < arguments.streams:
        seeds.append(picker.getrandbits(picker.choice((8, 16, 32, 48, 64))))

    entropies = seeds + [2**64, 2**96 - 1, 2**127, 2**128 - 1, picker.getrandbits(128)]
    entropies += [[], [5, 0]]
    entropies += [[picker.getrandbits(32) for _ in range(n)] for n in (1, 3, 4, 5, 8, 11)]
    seedings = [seeding(entropy) for entropy in entropies]
    for entropy in entropies[:7] + entropies[-13:]:
        seedings.append(seeding(entropy, (picker.choice((0, 1, 7, 2**32 - 1)),)))
        seedings.append(seeding(entropy, tuple(picker.getrandbits(32) for _ in range(3))))

    streams = [stream(seed, (), arguments.draws, picker) for seed in seeds]
    for key in ((0,), (1,), (3, 2**32 - 1)):
        streams.append(stream(picker.getrandbits(64), key, arguments.draws, picker))

    def rows(items):
        return "[\n" + ",\n".join(json.dumps(item, separators=(",", ":")) for item in items) + "\n]"

    print(f'{{"seedings":{rows(seedings)},\n"streams":{rows(streams)}}}')


if __name__ == "__main__":
    main()
