"""The page docs/results.md: all published tables of docs/, and the outcome of the claims of g3r and the paper."""
