"""The mask networks: one finds the fetal brain in a stack, one outlines it."""
