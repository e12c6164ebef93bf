"""What users are shown of a result: the verdict in words, and report.html."""
