"""Measurements of g3r: speed against accuracy, the kernels, and how time grows with size."""
