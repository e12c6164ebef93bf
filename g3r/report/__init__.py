"""What a person is told of a result: the verdict in words, and report.html."""
