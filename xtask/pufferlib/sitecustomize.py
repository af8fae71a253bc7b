"""On the path while pip builds PufferLib 3.0.0 with NO_OCEAN=1, that is, without the games that it would download.

In this case, its setup.py reads a name that it sets only when it builds the games.
"""

import builtins

builtins.c_extension_paths = []
