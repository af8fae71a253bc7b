"""Experiments of many runs: those of the paper, the tracks of the leaderboard, and the search for settings."""
