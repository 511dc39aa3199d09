"""The opponents of the benchmark: one method a file, with idea, limits and citation on top."""
