"""Evaluation: episodes, results, statistics, plots, films, probes, exports."""
