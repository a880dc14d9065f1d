"""Measurements, never tests: each module prints a table. Machines are shared, so read the ratios."""
