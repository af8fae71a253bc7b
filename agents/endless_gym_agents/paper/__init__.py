"""The paper's experiments, and the search for settings."""
