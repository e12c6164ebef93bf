"""What a reconstruction gives: the result, its record, files and pictures."""
