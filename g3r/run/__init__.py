"""Running a long computation: stages kept in files, deadlines, stop requests, output folders. Knows no MRI."""
