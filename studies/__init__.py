"""What measures the whole: scripts that need data from outside, run by hand or by `make bench-*`."""
