"""Records what pygame 2.4.0 paints, as JSON on standard output.

    SDL_VIDEODRIVER=dummy python record_raster.py > cases.json
    SDL_VIDEODRIVER=dummy python record_raster.py --scenes 5000 --episodes 8 --steps 200 \
        --scale-step 0.01 > wide.json    # a wider run, not stored

Needs pygame 2.4.0 and memory_gym 1.0.2. A scene is a list of operations on numbered surfaces, with
checks among them: the size of a surface and the CRC-32 of its pixels as [x][y][channel]. Colours
are 0xRRGGBB; floats are already truncated as pygame truncates them. Some scenes are random; the others
are the calls that the environments' pictures and episodes made, intercepted on the way to pygame.
"""

import argparse
import json
import math
import os
import random
import sys
import zlib

os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["SDL_AUDIODRIVER"] = "dummy"
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

import numpy as np
import pygame

BaseSurface = pygame.Surface
base_draw = {name: getattr(pygame.draw, name) for name in ("circle", "line", "rect")}
base_rotate, base_scale = pygame.transform.rotate, pygame.transform.scale

operations = []  # of the scene that is being recorded
numbers = {}  # of its surfaces, by their identity
kept = []  # keeps these surfaces, and with them their identities


def begin():
    operations.clear()
    numbers.clear()
    kept.clear()


def register(surface):
    """Gives a new surface the next number."""
    numbers[id(surface)] = len(kept)
    kept.append(surface)


def number(surface):
    return numbers[id(surface)]


def mapped(surface, color):
    return color if isinstance(color, int) else surface.map_rgb(color)


def pair(position):
    if isinstance(position, pygame.Rect):
        return position.x, position.y
    return int(position[0]), int(position[1])


def note(name, *arguments):
    operations.append({name: [int(a) if a is not None else None for a in arguments]})


def check(surface):
    crc = zlib.crc32(np.ascontiguousarray(pygame.surfarray.array3d(surface)).tobytes())
    note("check", number(surface), *surface.get_size(), crc)


class Surface(BaseSurface):
    """A pygame surface that records the operations on it."""

    def __init__(self, size, *arguments):
        super().__init__(size, *arguments)
        note("surface", *self.get_size())
        register(self)

    def fill(self, color):
        note("fill", number(self), mapped(self, color))
        return super().fill(color)

    def set_colorkey(self, color):
        note("color_key", number(self), None if color is None else mapped(self, color))
        super().set_colorkey(color)

    def set_alpha(self, alpha):
        note("alpha", number(self), alpha)
        super().set_alpha(alpha)

    def blit(self, source, position):
        note("blit", number(self), number(source), *pair(position))
        return super().blit(source, position)


def circle(surface, color, center, radius, width=0):
    note("circle", number(surface), mapped(surface, color), *pair(center), radius, width)
    return base_draw["circle"](surface, color, center, radius, width)


def line(surface, color, start, end, width=1):
    note("line", number(surface), mapped(surface, color), *pair(start), *pair(end), width)
    return base_draw["line"](surface, color, start, end, width)


def rect(surface, color, rect, width=0, radius=0, *corners):
    area = [int(value) for value in rect]
    name = "rounded_rect" if corners else "rect"
    note(name, number(surface), mapped(surface, color), *area, width, *corners)
    return base_draw["rect"](surface, color, rect, width, radius, *corners)


def rotate(surface, angle):
    source, result = number(surface), base_rotate(surface, angle)
    note("rotate", source, angle)
    register(result)
    return result


def scale(surface, size):
    source, result = number(surface), base_scale(surface, size)
    note("scale", source, *size)
    register(result)
    return result


pygame.Surface = Surface
pygame.draw.circle, pygame.draw.line, pygame.draw.rect = circle, line, rect
pygame.transform.rotate, pygame.transform.scale = rotate, scale


def noise(surface, seed):
    """Pseudorandom colours; about an eighth of the pixels are 0x010203."""
    note("noise", number(surface), seed)
    width, height = surface.get_size()
    with np.errstate(over="ignore"):
        values = np.arange(width * height, dtype=np.uint32) * np.uint32(2654435761)
        values ^= np.uint32(seed * 2246822519 & 0xFFFFFFFF)
        values ^= values >> np.uint32(15)
        values *= np.uint32(2246822519)
        values ^= values >> np.uint32(13)
    pixels = np.stack([values >> np.uint32(s) & np.uint32(255) for s in (16, 8, 0)], axis=-1)
    pixels[values >> np.uint32(29) == 0] = (1, 2, 3)
    if width and height:
        pixels = pixels.astype(np.uint8).reshape(width, height, 3)
        pygame.surfarray.blit_array(surface, pixels)


def random_scene(rng, draws):
    """A surface with random shapes drawn over each other."""
    size = (rng.choice([84, 84, rng.randint(1, 100)]), rng.choice([84, 84, rng.randint(1, 100)]))
    surface = Surface(size)
    span = rng.choice([0, 5, 60, 400])

    def x():
        return rng.randint(-span, size[0] + span)

    def y():
        return rng.randint(-span, size[1] + span)

    for _ in range(draws):
        color = rng.getrandbits(24)
        kind = rng.randrange(8)
        if kind <= 2:
            radius = rng.choice([rng.randint(-1, 12), rng.randint(1, 60), rng.randint(1, 500)])
            width = rng.choice([0, 0, 1, 1, 2, 3, rng.randint(-1, max(radius, 0) + 2), rng.randint(0, 20)])
            circle(surface, color, (x(), y()), radius, width)
        elif kind <= 4:
            width = rng.choice([1, 1, 2, 3, 4, rng.randint(-1, 30), rng.randint(0, 200)])
            start = (x(), y())
            end = rng.choice([(x(), y()), (start[0], y()), (x(), start[1]), start])
            if rng.random() < 0.3:
                reach = rng.randint(-90, 90)
                end = (start[0] + reach, start[1] + rng.choice([reach, -reach, reach + 1]))
            line(surface, color, start, end, width)
        else:
            area = (x(), y(), rng.randint(-3, 2 * size[0]), rng.randint(-3, 2 * size[1]))
            if rng.random() < 0.1:
                area = (*area[:2], rng.randint(-90, 3), rng.randint(-90, 90))
            width = rng.choice([0, 0, 1, 2, 3, rng.randint(-1, 60)])
            if kind <= 5:
                rect(surface, color, area, width)
            else:
                most = rng.choice([3, 12, 60, 300])
                corners = [rng.choice([0, rng.randint(0, most)]) for _ in range(4)]
                if rng.random() < 0.2:
                    corners = [most] * 4
                rect(surface, color, area, width, 0, *corners)
        check(surface)


def edge_scene():
    """Shapes that random scenes seldom have: corners as high as their rectangle, lines that end just
    off the surface, circles beyond an edge, borders about as wide as what is visible."""
    surface = Surface((60, 50))
    for height in (2, 3, 11, 41):
        for corners in [(0, 0, 45, 0), (45, 0, 0, 0), (0, 26, 0, 22), (0, 0, 3, 3), (9, 9, 9, 9)]:
            for width in (0, 1, 3):
                rect(surface, 0xFF8000 + height, (6, 4, 46, height), width, 0, *corners)
                check(surface)
    for offset in (-2, -1, 0, 1):
        for width in (1, 2, 5):
            for end in [(60 + offset, 17), (23, 50 + offset), (60 + offset, 50 + offset)]:
                line(surface, 0x0080FF + width, (-offset, -3), end, width)
                line(surface, 0x40C020 + width, end, (-7, -7), width)
                check(surface)
        for radius in (1, 2, 3, 20):
            for width in (0, 1, 2, 19):
                circle(surface, 0x800040 + radius, (offset - radius, 25), radius, width)
                circle(surface, 0x402040 + radius, (30, 50 + radius + offset), radius, width)
                check(surface)
        for width in (4, 5, 6):
            rect(surface, 0x123456 + width, (50 + offset, -20, 40, 90), width)
            check(surface)


def random_transformation(rng):
    """Surfaces with colour keys and alphas, rotated, scaled and blitted."""
    most = rng.choice([3, 12, 40, 90])
    source = Surface((rng.randint(0, most), rng.randint(0, most)))
    noise(source, rng.getrandbits(31))
    if rng.random() < 0.7:
        source.set_colorkey(0x010203)
    if rng.random() < 0.6:
        source.set_alpha(rng.choice([0, 1, 127, 128, 254, 255, 300, -5, rng.randint(0, 255)]))
    if rng.random() < 0.1:
        source.set_colorkey(None)
    kind = rng.randrange(4)
    angle = rng.choice([45, 90]) * rng.randint(-9, 9)
    if kind == 0:
        source = rotate(source, angle)
    elif kind == 1:
        source = scale(source, (rng.randint(0, 90), rng.randint(0, 90)))
    elif kind == 2:
        source = scale(rotate(source, angle), (rng.randint(0, 90), rng.randint(0, 90)))
    check(source)
    if kind != 3 and rng.random() < 0.3:
        # A transformed surface does not record the operations on it.
        if rng.random() < 0.5:
            alpha = rng.randint(0, 255)
            note("alpha", number(source), alpha)
            BaseSurface.set_alpha(source, alpha)
        else:
            key = rng.choice([0x010203, 0x010203, None])
            note("color_key", number(source), key)
            BaseSurface.set_colorkey(source, key)
    target = Surface((rng.randint(1, 90), rng.randint(1, 90)))
    noise(target, rng.getrandbits(31))
    for _ in range(3):
        target.blit(source, (rng.randint(-50, 90), rng.randint(-50, 90)))
    check(target)


def alpha_sweep(mode, levels):
    """The checksums of blending every level over every other level, per alpha."""
    sums = []
    values = np.arange(256, dtype=np.uint8)
    over = np.repeat(np.broadcast_to(values[:, None, None], (256, 256, 1)), 3, axis=2)
    below = np.ascontiguousarray(over.transpose(1, 0, 2))
    for alpha in levels:
        source, target = BaseSurface((256, 256)), BaseSurface((256, 256))
        pygame.surfarray.blit_array(source, over)
        pygame.surfarray.blit_array(target, below)
        if mode != "plain":
            source.set_colorkey((1, 2, 3))
        source.set_alpha(alpha)
        if mode == "encoded":
            source = base_rotate(source, 0)
        target.blit(source, (0, 0))
        sums.append([alpha, zlib.crc32(pygame.surfarray.array3d(target).tobytes())])
    return {"mode": mode, "sums": sums}


def agent_pictures(agent_scale):
    from memory_gym.character_controller import CharacterController

    agent = CharacterController(8, 3, agent_scale)
    for surface in agent.character_surfaces:
        check(surface)


def command_pictures(command_scale):
    from memory_gym.pygame_assets import Command

    for name in ["", *Command.COMMANDS]:
        check(Command(name, command_scale).surface)


def tile_pictures(tile_scale):
    from memory_gym import pygame_assets as assets

    tile = assets.MortarTile(56 * tile_scale, tile_scale, (0, 0), (0, 0, 0, 0))
    check(tile.surface)
    tile.toggle_color(True)
    check(tile.surface)
    check(assets.draw_icy_surface(int(56 * tile_scale)))
    check(assets.draw_column_tile_surface(56 * tile_scale, 7))
    dim = 160 * tile_scale
    cross = Surface((dim, dim))
    line(cross, (255, 0, 0), (0, 0), (dim - 1, dim - 1), int(48 * tile_scale))
    line(cross, (255, 0, 0), (dim - 1, 0), (0, dim - 1), int(48 * tile_scale))
    check(cross)


def spotlight_pictures(item_scale):
    from memory_gym import pygame_assets as assets

    exit_ = assets.Exit((40, 40), item_scale)
    for is_open in (False, True):
        exit_.open = not is_open
        exit_.draw(is_open)
        check(exit_.surface)
    surface = Surface((84, 84))
    surface.fill(255)
    for position in [(42, 42), (3, 80), (83, 10)]:
        assets.Coin(item_scale, position).draw(surface)
        check(surface)
    background = assets.get_tiled_background_surface(surface, 84, (0, 0, 255), max(item_scale, 0.02))
    check(background)


def episode(name, options, seed, steps, debug_views):
    """The reset and some steps of an environment, each followed by a check of the observation."""
    import gymnasium

    screen = None

    def set_mode(size, *_, **__):
        nonlocal screen
        screen = Surface(size)
        return screen

    saved = {key: getattr(pygame.display, key) for key in ("set_mode", "get_surface", "flip")}
    pygame.display.set_mode = set_mode
    pygame.display.get_surface = lambda: screen
    pygame.display.flip = lambda: None
    env = gymnasium.make(name, disable_env_checker=True).unwrapped
    rng = random.Random(seed)
    known = env.default_reset_parameters
    env.reset(seed=seed, options={key: value for key, value in options.items() if key in known})
    check(screen)
    for step in range(steps):
        if hasattr(env.action_space, "nvec"):
            action = [rng.randrange(n) for n in env.action_space.nvec]
        else:
            action = rng.randrange(env.action_space.n)
        done = env.step(action)[2]
        check(screen)
        if step % max(steps // debug_views, 1) == 0 and hasattr(env, "_build_debug_surface"):
            check(env._build_debug_surface())
        if done:
            break
    for key, value in saved.items():
        setattr(pygame.display, key, value)


def option_sets(rng):
    """Options that change what is drawn, per environment; those that it does not know are omitted."""
    agent_scale = rng.choice([0.1, 0.25, 0.3, 0.5, 1.0])
    quick = {
        "command_count": [2], "command_show_duration": [1], "command_show_delay": [1],
        "explosion_duration": [1, 2], "explosion_delay": [1, 3],
    }
    yield "MortarMayhem-v0", {"agent_scale": agent_scale, **quick}
    yield "MortarMayhem-Grid-v0", {"agent_scale": agent_scale, "arena_size": 6, **quick}
    yield "MortarMayhemB-v0", {"agent_scale": agent_scale, **quick}
    yield "MortarMayhemB-Grid-v0", {"agent_scale": agent_scale, "arena_size": 4, **quick}
    yield "Endless-MortarMayhem-v0", {"agent_scale": agent_scale, **quick}
    yield "MysteryPath-v0", {"agent_scale": agent_scale, "show_origin": True, "show_goal": True}
    yield "MysteryPath-Grid-v0", {"agent_scale": agent_scale}
    yield "Endless-MysteryPath-v0", {
        "agent_scale": agent_scale, "show_past_path": rng.random() < 0.5,
        "show_background": rng.random() < 0.5, "show_stamina": True,
    }
    spotlights = {
        "agent_scale": agent_scale, "spot_min_radius": 2.5 + 7 * rng.random(),
        "spot_max_radius": 10 + 10 * rng.random(), "light_dim_off_duration": rng.choice([2, 6, 9]),
        "light_threshold": rng.choice([180, 255, 120]), "black_background": rng.random() < 0.3,
        "hide_chessboard": rng.random() < 0.3, "coin_scale": rng.choice([0.2, 0.375, 0.7]),
        "initial_spawns": 4, "spawn_interval": 3, "coins_visible": rng.random() < 0.5,
        "agent_visible": rng.random() < 0.5,
    }
    yield "Endless-SearingSpotlights-v0", dict(spotlights)
    yield "SearingSpotlights-v0", {
        **spotlights, "exit_scale": rng.choice([0.3, 0.5, 1.0]), "num_coins": [2],
        "exit_visible": rng.random() < 0.5,
    }


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=70, help="random scenes of each kind")
    parser.add_argument("--draws", type=int, default=12, help="shapes per random scene")
    parser.add_argument("--episodes", type=int, default=1, help="episodes per environment")
    parser.add_argument("--steps", type=int, default=8, help="steps per episode")
    parser.add_argument("--scale-step", type=float, default=0.15, help="between the assets' scales")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    pygame.display.init()
    pygame.display.set_mode((84, 84), pygame.NOFRAME)
    import memory_gym  # noqa: F401, registers the environments

    rng = random.Random(arguments.seed)
    scenes = []

    def record(function, *parameters):
        begin()
        function(*parameters)
        scenes.append(list(operations))

    scales = [i * arguments.scale_step for i in range(1, math.ceil(1.5 / arguments.scale_step) + 1)]
    for value in {0.05, 0.25, *scales}:
        record(agent_pictures, value)
    for value in [0.25, *scales[1:]]:
        record(command_pictures, value)
    for value in [0.25, *scales]:
        record(tile_pictures, value)
        record(spotlight_pictures, value)
    record(spotlight_pictures, 0.375)
    for _ in range(arguments.episodes):
        for name, options in option_sets(rng):
            seed = rng.getrandbits(20)
            record(episode, name, options, seed, arguments.steps, 2)
    record(edge_scene)
    for _ in range(arguments.scenes):
        record(random_scene, rng, arguments.draws)
        record(random_transformation, rng)
        record(random_transformation, rng)
    sweeps = [
        alpha_sweep("plain", range(256)),
        alpha_sweep("keyed", range(256)),
        alpha_sweep("encoded", [0, 1, 64, 127, 128, 200, 254, 255]),
    ]
    json.dump({"scenes": scenes, "alpha_sweeps": sweeps}, sys.stdout, separators=(",", ":"))
    print()


if __name__ == "__main__":
    main()
