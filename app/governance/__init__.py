"""Stratum 3 of the paper as pure functions: no clock, no I/O, no randomness; time arrives as an argument."""
