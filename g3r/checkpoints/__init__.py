"""Exported weights: the one reader and writer of files that may come from anywhere."""
