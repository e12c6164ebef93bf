"""What a finished run is good for afterwards: other grids, other images of the same slices, other programs' files."""
