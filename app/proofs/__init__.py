"""What is proved of a policy before it decides anything: `reins policy check`."""
