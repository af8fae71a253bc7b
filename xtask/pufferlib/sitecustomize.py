"""On the path while pip builds PufferLib 3.0.0 with NO_OCEAN=1, without the games whose sources it would fetch from GitHub.

Its setup.py then reads a name that it only sets where the games are built.
"""

import builtins

builtins.c_extension_paths = []
