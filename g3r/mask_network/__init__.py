"""The mask network: it finds the fetal brain in a stack and outlines it."""
