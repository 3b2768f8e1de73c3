"""Protocols, baselines, metrics and reports that measure governance methods against each other."""
