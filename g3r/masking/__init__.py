"""Brain masks for stacks that come without one, by the mask network or by a command of the user."""
