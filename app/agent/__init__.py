"""Stratum 1: the client SDK and a reference agent. Talks HTTP only."""
