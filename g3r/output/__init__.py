"""Output of a reconstruction: the result, its record, files and pictures."""
