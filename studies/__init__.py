"""Studies that measure the tables of docs/, a folder per page.

`make study-PAGE.NAME`, or `python -m studies.PAGE.NAME`.
"""
