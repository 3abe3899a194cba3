"""The tracking benchmark: sequences with known truth, peers on the same frames, figures, report."""
