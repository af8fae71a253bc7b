"""A window that shows pictures with pygame, which is imported when the first window opens."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Width and height of the window in pixels: those of the ground-truth view. Frames are magnified.
_SIZE = 336

#: SDL drivers that show nothing. SDL chooses one of them if there is no display.
_INVISIBLE = ("dummy", "offscreen")


class WindowClosed(RuntimeError):
    """The user has closed the window of `render_mode="human"`.

    `reset` and `step` raise it before they play, and keep raising it until `close` is called.
    """


class Window:
    """A window of 336x336 pixels.

    Raises:
        ImportError: pygame is not installed.
        RuntimeError: There is no display.
    """

    def __init__(self) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ImportError(
                "render_mode=\"human\" needs pygame: pip install './bindings/python[render]', or the wheel file with `[render]` "
                "appended"
            ) from error
        self._pygame: Any = pygame
        try:
            pygame.display.init()
        except pygame.error as error:
            raise _no_display(str(error)) from error
        driver = pygame.display.get_driver()
        if driver in _INVISIBLE and driver not in os.environ.get("SDL_VIDEODRIVER", "").split(","):
            pygame.display.quit()
            raise _no_display(f"SDL chose the driver {driver!r}, which shows nothing")
        self._screen = pygame.display.set_mode((_SIZE, _SIZE))
        self._next = time.monotonic()

    def show(self, picture: NDArray[np.uint8], title: str) -> None:
        """Shows a picture, (height, width, 3), enlarged to the window."""
        scale = _SIZE // len(picture)
        if scale > 1:
            picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)
        self._pygame.display.set_caption(title)
        self._pygame.surfarray.blit_array(self._screen, picture.swapaxes(0, 1))
        self._pygame.display.flip()

    def is_closed_by_user(self) -> bool:
        """Whether the window's close button was used since the last call. Other events stay in pygame's queue."""
        # The program may have ended pygame itself.
        return not self._pygame.display.get_init() or bool(self._pygame.event.get(self._pygame.QUIT))

    def wait(self, fps: int) -> None:
        """Waits until the next picture is due."""
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = time.monotonic() + 1 / fps

    def close(self) -> None:
        """Closes the window."""
        self._pygame.display.quit()


def _no_display(reason: str) -> RuntimeError:
    return RuntimeError(
        f'render_mode="human" needs a display, and there is none ({reason}; DISPLAY is {os.environ.get("DISPLAY")!r}, '
        f'WAYLAND_DISPLAY is {os.environ.get("WAYLAND_DISPLAY")!r}): use render_mode="rgb_array" or "debug_rgb_array", '
        "or set SDL_VIDEODRIVER=dummy to show nothing"
    )
