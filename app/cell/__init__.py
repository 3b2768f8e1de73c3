"""Runs one session under watch next to the robot: the tick loop, the link to the server, the substrate's protocol."""
