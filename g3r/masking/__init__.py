"""Masking: brain masks for stacks that come without one, by the network or by a command of the user's."""
