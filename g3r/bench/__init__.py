"""What measures: the trade of speed against accuracy, scaling, and the kernels."""
