"""Further uses of a finished run: other grids, other images of the same slices, files of other programs."""
