"""What the scanner gives and how it sees: stacks, planes, PSF, the voxel operator, density."""
