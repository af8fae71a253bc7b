"""What vector environments are asked for, and their results: configuration, resets, options and steps."""
