"""The opponents of the benchmark: one method a file, with what it is, its limits and its citation on top."""
