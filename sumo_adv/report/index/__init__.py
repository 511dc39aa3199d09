"""The index of a batch: all episodes in one page that sorts, filters and leads to each one's replay."""
