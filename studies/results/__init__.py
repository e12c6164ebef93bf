"""What docs/results.md shows: every published table of docs/, and what becomes of the claims of g3r and the paper."""
