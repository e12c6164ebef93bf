"""Measurements for the documents: a folder per page. `python -m studies.PAGE.NAME`, or `make study-NAME`."""
