"""The environments that agents play: vectors of them, wrappers, replacement of a lost engine, ranks."""
