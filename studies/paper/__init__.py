"""What docs/paper.md shows: the paper's protocol with this code, baselines, and other programs on the same subjects."""
