"""Registration measured: the tables of docs/motion.md."""
