"""Motion prediction with a small Transformer in the manner of HiVT: data, training, inference in numpy, evaluation."""
