"""Exported weights: the only reader and writer of these files, which may come from any source."""
